"""RL116 and RL810 to RL815: how an environment drives and reads the robots of a PyBullet world."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.bullet_worlds import JOINTS, ClientCalls
from rlctl.checking.rules import RuleFinding, Severity
from rlctl.checking.world_logs import LoggedWorld, WorldLog
from rlctl.environments.bullet_calls import FULL_TURN, BulletCalls, ContactQuery

FAR_RANGES = 3.0  # a target farther outside the limits is not just out of reach
FEWEST_JOINTS, FEWEST_QUERIES, FEWEST_LOOKS = 3, 50, 30
LATE_LINK = 0.001  # [m]
NEAR, APART = 0.05, 0.2  # of sorted targets and positions; of a target and its own joint's position [rad], [m]
MOSTLY = 0.3  # Part of all looks in which bodies have to touch, so that a query should have seen it
SAME = 2e-4  # An element of the observation is an angle if it differs by no more in any look [rad]
LEAST_MOTION = 0.02  # standard deviation; calmer angles may be equal by chance [rad]
ORDERS = {"w, x, y, z": (1, 2, 3, 0), "w first, passed on as x, y, z, w": (3, 0, 1, 2)}  # where x, y, z, w come from
ANGLES = (*("roll", "pitch", "yaw") * 3, "", "", "")


def _find_far_targets(worlds: Sequence[LoggedWorld], calls: BulletCalls) -> Iterator[RuleFinding]:
    bodies = [(world.world.client, body) for world in worlds for body in world.world.bodies]
    joints = {(client, body.id, joint.index): joint for client, body in bodies for joint in body.joints}
    for target in calls.far_targets:
        joint = joints.get((target.client, target.body, target.joint))
        if joint is None or not joint.is_angle or not joint.has_limits:
            continue
        outside = max(joint.low - target.value, target.value - joint.high)
        if outside > FAR_RANGES * (joint.high - joint.low) and abs(target.value) > FULL_TURN:
            limits = f"its limits are [{joint.low:.3g}, {joint.high:.3g}] rad: degrees?"
            message = f"{target.call.name} gives joint {joint.name} the position {target.value:.4g} rad; {limits}"
            evidence = {"element": joint.name, "value": target.value, "expected": [joint.low, joint.high]}
            yield RuleFinding("RL810", message, evidence, where=(target.call.file, target.call.line))
            return


def _find_wrong_order(world: LoggedWorld) -> Iterator[RuleFinding]:
    for log in world.logs:
        for body, states in log.bodies if log.first_targets else ():
            keys = [(world.world.client, body.id, joint.index) for joint in body.joints]
            driven = {j: log.first_targets[key] for j, key in enumerate(keys) if key in log.first_targets}
            if len(driven) < FEWEST_JOINTS:
                continue
            positions = states[0, [JOINTS + j for j in driven]]
            values = np.array([target.value for target in driven.values()])
            order = np.argsort(values, kind="stable")
            is_sorted_same = np.abs(values[order] - np.sort(positions)).max() <= NEAR
            wrong = np.flatnonzero(np.abs(values - positions) > APART)
            if is_sorted_same and wrong.size >= 2:
                (index, target), position = list(driven.items())[wrong[0]], float(positions[wrong[0]])
                targets, joint = f"the {len(driven)} motor targets of {body.name}", body.joints[index].name
                what = f"with the zero action {targets} are its joint positions at reset in another order"
                message = f"{what}: {joint} is at {position:.3g} and gets {target.value:.3g}"
                evidence = {"element": joint, "value": target.value, "expected": position}
                yield RuleFinding("RL811", message, evidence, where=(target.call.file, target.call.line))
                return


def _find_weak_motors(world: LoggedWorld, calls: BulletCalls) -> Iterator[RuleFinding]:
    p = ClientCalls(world.world.client)
    for body, states in world.logs[0].bodies:
        still = [0.0] * len(body.joints)
        positions = states[0, JOINTS : JOINTS + len(body.joints)].tolist()
        try:
            if body.is_free or not still or p.getNumConstraints():  # a constraint may carry it
                continue
            torques = p.calculateInverseDynamics(body.id, positions, still, still)
        except p.error:  # it has joints of several degrees of freedom
            continue
        for joint, torque in zip(body.joints, np.abs(torques).tolist(), strict=True):
            target = calls.targets.get((world.world.client, body.id, joint.index))
            if target is not None and 0 < target.force < torque:
                unit = "N m" if joint.is_angle else "N"
                needed = f"to hold the weight at reset takes {torque:.4g} {unit}"
                message = f"the motor of {joint.name} has at most {target.force:.4g} {unit}, and {needed}"
                evidence = {"element": joint.name, "value": target.force, "expected": torque}
                yield RuleFinding("RL814", message, evidence, where=(target.call.file, target.call.line))
                return


def _find_late_links(calls: BulletCalls) -> Iterator[RuleFinding]:
    call = max(calls.late_links, key=lambda call: calls.late_links[call], default=None)
    if call is not None and (distance := calls.late_links[call]) > LATE_LINK:
        message = f"getLinkState returns the position before the last physics step: up to {1e3 * distance:.3g} mm away"
        yield RuleFinding("RL815", message, {"value": distance, "expected": 0.0}, where=(call.file, call.line))


def _find_empty_queries(world: LoggedWorld, calls: BulletCalls) -> Iterator[RuleFinding]:
    key = lambda query: (query.call, query.client)  # noqa: E731
    for (call, client), group in itertools.groupby(sorted(calls.queries.values(), key=key), key):
        queries = list(group)
        total = sum(query.calls for query in queries)
        if client != world.world.client or total < FEWEST_QUERIES or any(query.contacts for query in queries):
            continue
        for query in queries:
            if why := _explain_empty(world, query):
                text, severity = why
                message = f"{total} calls of getContactPoints returned no contact: {text}"
                evidence = {"element": f"bodies {query.bodies}, links {query.links}", "value": 0}
                yield RuleFinding("RL812", message, evidence, severity, where=(call.file, call.line))
                return


def _explain_empty(world: LoggedWorld, query: ContactQuery) -> tuple[str, Severity] | None:
    p, known = ClientCalls(query.client), {body.id for body in world.world.bodies}
    existing = {-1, *(p.getBodyUniqueId(i) for i in range(p.getNumBodies()))}
    for body, link in zip(query.bodies, query.links, strict=True):
        if body not in existing:
            return f"there is no body {body}", Severity.WARNING
        if body in known and link is not None and not _has_shape(world, body, link):
            name = world.world.link_name((body, link))
            return f"{name} (link {link}) has no collision shape", Severity.WARNING
    looks = [links for log in world.logs for links in _find_touching(log, query)]
    others = {link for links in looks for link in links}
    if not looks or sum(bool(links) for links in looks) < MOSTLY * len(looks) or query.links == (None, None):
        return None
    asked = next((body, link) for body, link in zip(query.bodies, query.links, strict=True) if link is not None)
    other = sorted(others)[0]
    text = f"{world.world.link_name(asked)} (link {asked[1]}) never touched, but {world.world.link_name(other)} did"
    is_next = any(_are_joined(query.client, asked, link) for link in others)
    return f"{text} (link {other[1]})", Severity.WARNING if is_next else Severity.INFO


def _has_shape(world: LoggedWorld, body: int, link: int) -> bool:
    p, others = ClientCalls(world.world.client), [other.id for other in world.world.bodies if other.id != body]
    return not others or any(p.getClosestPoints(other, body, 1e3, linkIndexB=link) for other in others)


def _find_touching(log: WorldLog, query: ContactQuery) -> list[set[tuple[int, int]]]:
    """Return, for each look, the links of the asked body that touch the other one, or anything where none is named."""
    asked = 0 if query.links[0] is not None else 1
    one, other = query.bodies[asked], query.bodies[1 - asked]
    looks = []
    for pairs in log.touching:
        both = [*pairs, *((b, a) for a, b in pairs)]
        looks.append({a for a, b in both if a[0] == one and a[0] != b[0] and other in (-1, b[0])})
    return looks


def _are_joined(client: int, one: tuple[int, int], two: tuple[int, int]) -> bool:
    p = ClientCalls(client)
    pairs = (one, two), (two, one)
    return any(link >= 0 and p.getJointInfo(body, link)[16] == parent for (body, link), (_, parent) in pairs)


def _find_misread_quaternions(world: LoggedWorld) -> Iterator[RuleFinding]:
    logs = [log for log in world.logs if log.observed and len({row.size for row in log.observed}) == 1]
    if sum(len(log.observed) for log in logs) < FEWEST_LOOKS or len({log.observed[0].size for log in logs}) != 1:
        return
    observed = np.concatenate([np.stack(log.observed) for log in logs]).astype(np.float64)
    moving = np.flatnonzero(observed.std(axis=0) > LEAST_MOTION)
    links = set.intersection(*(set(orientations) for log in logs for orientations in log.orientations))
    right, wrong = [], []
    for link in sorted(links):
        quaternions = np.array([orientations[link] for log in logs for orientations in log.orientations])
        right.append(find_angles(quaternions))
        wrong += [(link, name, find_angles(quaternions[:, order])) for name, order in ORDERS.items()]
    for column in moving:
        values = observed[:, column, None]
        if any((np.abs(np.abs(values) - np.abs(angles)).max(axis=0) <= SAME).any() for angles in right):
            continue
        for link, order, angles in wrong:
            is_same = (np.abs(values - angles).max(axis=0) <= SAME) & (angles.std(axis=0) > LEAST_MOTION)
            for which in np.flatnonzero(is_same)[:1]:
                angle = f"{('', 'the sine of ', 'the cosine of ', 'gravity')[which // 3]}{ANGLES[which]}"
                name = f"observation[{column}]"
                message = f"{name} is {angle} of {world.world.link_name(link)} with its quaternion read as {order}"
                yield RuleFinding("RL116", message, {"element": name, "value": order, "expected": "x, y, z, w"})
                return


def find_angles(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return roll, pitch and yaw, their sines and cosines, and the direction of gravity in the body's frame, shape
    (n, 12), of quaternions x, y, z, w, shape (n, 4)."""
    x, y, z, w = quaternions.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    angles = np.stack([roll, pitch, yaw], axis=1)
    down = -np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    return np.concatenate([angles, np.sin(angles), np.cos(angles), down], axis=1)


def find_misuses(worlds: Sequence[LoggedWorld], calls: BulletCalls) -> Iterator[RuleFinding]:
    """Yield what is wrong with how the robots of some worlds are driven and read; the worlds have to be there still."""
    yield from _find_far_targets(worlds, calls)
    yield from _find_late_links(calls)
    for world in worlds:
        yield from _find_wrong_order(world)
        yield from _find_weak_motors(world, calls)
        yield from _find_empty_queries(world, calls)
        yield from _find_misread_quaternions(world)
