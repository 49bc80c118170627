"""RL812 and RL815 of PyBullet, and all that `find_misuses` joins: how an environment drives and reads its robots."""

import itertools
from collections.abc import Iterator, Sequence

from rlctl.checking.families.joint_readings import find_misread_joints
from rlctl.checking.families.motors import find_wrong_motors
from rlctl.checking.families.readings import find_misread_quaternions, find_old_elements
from rlctl.checking.rule import RuleFinding, Severity, list_names
from rlctl.checking.world_logs import LoggedWorld, WorldLog
from rlctl.checking.worlds import Array
from rlctl.environments.bullet_calls import BulletCalls, ContactQuery
from rlctl.environments.bullet_clients import ClientCalls

FEWEST_QUERIES = 50
LATE_LINK = 0.001  # [m]
MOSTLY = 0.3  # Part of all looks in which bodies have to touch, so that a query should have seen it


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
            if why := _explain_empty(world, query) or _explain_alone(world, query, calls):
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


def _explain_alone(world: LoggedWorld, query: ContactQuery, calls: BulletCalls) -> tuple[str, Severity] | None:
    """Explain an empty query of one of several links that are alike, of which no other is ever asked."""
    side = 0 if query.links[0] is not None else 1
    (body, link), other = (query.bodies[side], query.links[side]), query.bodies[1 - side]
    if link is None or link < 0 or query.links[1 - side] is not None:
        return None
    asked = {
        (asked.bodies[end], asked.links[end])
        for asked in calls.queries.values()
        for end in (0, 1)
        if asked.client == query.client and asked.bodies[1 - end] in (other, -1) and asked.call.file == query.call.file
    }
    twins = _find_twins(query.client, body, link)
    if not twins or asked & {(body, twin) for twin in (*twins, None, -1)}:
        return None
    names = list_names([f"{world.world.link_name((body, twin))} (link {twin})" for twin in twins])
    text = f"it asks for {world.world.link_name((body, link))} (link {link}) alone, and nothing asks for {names}"
    return f"{text}, which are like it: same parent, mass and inertia", Severity.WARNING


def _find_twins(client: int, body: int, link: int) -> list[int]:
    """Return the other links with the same parent, mass and inertia."""
    p = ClientCalls(client)

    def describe(number: int) -> tuple[object, ...]:
        mass, _, inertia, *_ = p.getDynamicsInfo(body, number)
        return p.getJointInfo(body, number)[16], mass, inertia

    others = [number for number in range(p.getNumJoints(body)) if number != link]
    weighs = p.getDynamicsInfo(body, link)[0] > 0
    return [number for number in others if weighs and describe(number) == describe(link)]


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


def find_misuses(worlds: Sequence[LoggedWorld], calls: BulletCalls, low: Array, high: Array) -> Iterator[RuleFinding]:
    """Yield what is wrong with how the robots of some worlds are driven and read; the worlds have to be there still.
    `low` and `high` bound the action, shape (n,)."""
    yield from _find_late_links(calls)
    for world in worlds:
        yield from find_wrong_motors(world, calls, low, high)
        yield from find_misread_quaternions(world)
        yield from find_old_elements(world)
        yield from find_misread_joints(world)
        yield from _find_empty_queries(world, calls) if world.world.engine == "PyBullet" else ()
