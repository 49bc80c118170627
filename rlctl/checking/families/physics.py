"""RL8: the physics, as PyBullet has it while the environment runs."""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rlctl.checking.records import ChildMessage, Skipped
from rlctl.checking.rule import RuleFinding, Severity, list_names
from rlctl.checking.values import is_task
from rlctl.checking.world_logs import LoggedWorld, Place, WorldLog
from rlctl.checking.worlds import ANGULAR, JOINTS, VELOCITY, Array, Joint, Jump, Pair, WorldBody
from rlctl.environments.bullet_calls import FULL_TURN

LASTING_STEPS = 3  # shorter events are impacts that the solver has not resolved yet
LASTING_SOFT = 10  # the same for contacts of MuJoCo, which are soft by design, if they begin after a reset
PART_OF_RANGE, LEAST_ANGLE, LEAST_LENGTH = 0.1, 0.05, 0.01
"""How far outside its limits a joint may be: part of the range, and at least so much [rad], [m]."""
FASTEST_BASE = 50.0  # [m/s]; PyBullet stops at 100 per axis, and no robot is faster than a car
FASTEST_JOINT, FASTEST_SLIDE = 90.0, 50.0  # [rad/s], [m/s]; PyBullet stops at 100; arms and legs stay below 30
FASTEST_MEANT, NONSENSE = 100.5, 5_000.0  # between them the author raised the limit, for example for wheels
FASTEST_JUMP = 1.0  # above falling, 0.1 s after a reset: ten times gravity [m/s]
RADIANS = 'Write <compiler angle="radian"/> into the model file: angles in MJCF are degrees unless it says so.'
LONGEST_TIME_STEP = 0.02  # PyBullet's own is 1/240 [s]


def find_model_faults(env: Any) -> Iterator[ChildMessage]:
    """Yield what is wrong with the model files of a task."""
    if not is_task(env):
        yield Skipped("RL809", "only the model files of tasks of rlctl are known", applies=False)
        return
    from rlctl.task.model_faults import find_frames, find_model_faults

    for body in env.unwrapped.sim.bodies.values():
        for fault in find_model_faults(body):
            yield RuleFinding("RL809", fault.rstrip("."))
        if frames := find_frames(body):
            yield RuleFinding("RL809", frames, severity=Severity.INFO)


def judge_logs(world: LoggedWorld) -> Iterator[ChildMessage]:
    """Yield what is wrong with the physics of a world."""
    if world.time_step > LONGEST_TIME_STEP:
        evidence = {"value": world.time_step, "expected": f"up to {LONGEST_TIME_STEP:g}"}
        yield RuleFinding("RL813", f"a step of the physics takes {world.time_step:.4g} s", evidence)
    explosions = list(_explosion(world))
    yield from explosions
    if explosions:
        for rule in ("RL803", "RL804"):
            yield Skipped(rule, "the simulation diverges (RL805)")  # which explains what else is odd
    else:
        yield from _penetration(world)
        yield from _joint_limits(world)
    yield from _unrest(world)


def _when(place: Place) -> str:
    return f"at step {place['step']}" if place["step"] else "at reset"


def _penetration(world: LoggedWorld) -> Iterator[RuleFinding]:
    thrown = _thrown(world)
    worst: dict[Pair, tuple[float, WorldLog, list[int]]] = {}
    for log in world.logs:
        for pair in {pair for deep in log.deep for pair in deep} if log.actions != "extreme" else ():
            row = _longest_row([pair in deep for deep in log.deep])
            depth = max(log.deep[i][pair][0] for i in row)
            names = [log.world.link_name(link) for link in pair]
            # What is inside each other since the reset and is thrown out is RL807.
            is_thrown = log.places[row[0]]["step"] <= 1 and any(body in name for body in thrown for name in names)
            lasting = LASTING_SOFT if world.world.engine == "MuJoCo" and log.places[row[0]]["step"] else LASTING_STEPS
            if len(row) >= lasting and not is_thrown and depth > worst.get(pair, (0.0,))[0]:
                worst[pair] = depth, log, row
    for pair, (depth, log, row) in sorted(worst.items(), key=lambda item: -item[1][0])[:1]:
        at = max(row, key=lambda i: log.deep[i][pair][0])
        limit, place = log.deep[at][pair][1], log.places[at]
        names = [log.world.link_name(link) for link in sorted(pair, reverse=True)]  # what is fixed comes last
        more = f"; so are {len(worst) - 1} other pairs of links" if len(worst) > 1 else ""
        lasts = f"deeper than {100 * limit:.1f} cm for {len(row)} steps in a row{more}"
        message = f"{names[0]} is {100 * depth:.1f} cm inside {names[1]} {_when(place)}, and {lasts}"
        yield RuleFinding("RL803", message, {**place, "value": depth, "expected": limit, "links": names})


def _longest_row(is_deep: Sequence[bool]) -> list[int]:
    groups = itertools.groupby(range(len(is_deep)), key=is_deep.__getitem__)
    return max((list(row) for deep, row in groups if deep), key=len, default=[])


def _joint_limits(world: LoggedWorld) -> Iterator[RuleFinding]:
    joints: list[tuple[float, str, Joint, int, Place, float]] = []
    for log in world.logs:
        for body, states in log.bodies:
            for j, joint in enumerate(body.joints):
                positions = states[:, JOINTS + j]
                outside = _outside(joint, positions)
                steps, row = int((outside > 0).sum()), int(outside.argmax())
                if _is_kept_there(log, outside):
                    name, place = f"{joint.name} of {body.name}", log.places[row]
                    joints.append((float(outside[row]), name, joint, steps, place, float(positions[row])))
    joints.sort(key=lambda record: -record[0])
    names = list(dict.fromkeys(record[1] for record in joints))
    for widths, name, joint, steps, place, value in joints[:1]:
        unit = "rad" if joint.is_angle else "m"
        more = f"; outside of theirs are {list_names(names[1:])}" if names[1:] else ""
        limits = f"its limits are [{joint.low:.3g}, {joint.high:.3g}] {unit}"
        lasts = f"it is far outside them in {steps} steps{more}"
        message = f"{name} is at {value:.3g} {unit} {_when(place)}; {limits}; {lasts}"
        evidence = {**place, "joint": name, "value": value, "expected": [joint.low, joint.high]}
        fix = ""
        if _is_read_as_degrees(world, joint, widths):
            low, high = np.degrees([joint.low, joint.high])
            message += f". The model file may have meant {low:.4g} to {high:.4g} in radians, and was read in degrees"
            fix = RADIANS
        yield RuleFinding("RL804", message, {**evidence, "other_joints": names[1:]}, fix=fix)


def _is_read_as_degrees(world: LoggedWorld, joint: Joint, widths: float) -> bool:
    """Say whether limits look like radians that MuJoCo's compiler took for degrees, as it does unless it is told: no
    hinge has wider ones than a full turn of such degrees, and this one is outside by more than their width."""
    limited = [j for body in world.world.bodies for j in body.joints if j.is_angle and j.has_limits]
    is_small = all(max(abs(j.low), abs(j.high)) <= math.radians(FULL_TURN) for j in limited)
    return world.world.engine == "MuJoCo" and joint in limited and is_small and widths > 1


def _is_kept_there(log: WorldLog, outside: Array) -> bool:
    """Say whether a joint is beyond its limits for more than a moment. MuJoCo's limits are soft by design: what counts
    there is where a reset puts a joint, or where it mostly is."""
    steps = int((outside > 0).sum())
    if log.world.engine == "MuJoCo":
        is_mostly = steps > max(LASTING_STEPS, len(outside) // 2)
        return bool(outside[0] > 0) or (is_mostly and log.actions != "extreme")
    return steps >= LASTING_STEPS


def _outside(joint: Joint, values: Array) -> Array:
    """Return how far a joint is outside its limits, in parts of their width; 0 where that is little."""
    if not joint.has_limits:
        return np.zeros(len(values))
    width = joint.high - joint.low
    allowed = max(PART_OF_RANGE * width, LEAST_ANGLE if joint.is_angle else LEAST_LENGTH)
    outside = np.maximum(joint.low - values, values - joint.high)
    return np.where(np.isfinite(outside) & (outside > allowed), outside / width, 0.0)


def _explosion(world: LoggedWorld) -> Iterator[RuleFinding]:
    fastest = [record for log in world.logs for body, states in log.bodies for record in _fast(log, body, states)]
    fastest.sort(key=lambda record: -record[0])
    parts = {part for _, part, *_ in fastest}
    failed = [log for log in world.logs if log.failure and log.actions != "extreme"]
    for log in failed[:1]:
        yield RuleFinding("RL805", log.failure, {**log.places[-1], "actions": log.actions})
    for _, _, message, evidence in fastest[:1] if not failed else ():
        more = f", and {len(parts) - 1} more" if len(parts) > 1 else ""  # its consequences
        yield RuleFinding("RL805", message + more, evidence)


def _fast(log: WorldLog, body: WorldBody, states: Array) -> Iterator[tuple[float, str, str, Place]]:
    for row, column in np.argwhere(~np.isfinite(states))[:1].tolist():
        value, place = str(states[row, column]), log.places[row]
        message = f"the state of {body.name} is {value} {_when(place)}"
        yield math.inf, body.name, message, {**place, "value": value, "expected": "finite"}
        return
    linear, angular = (np.linalg.norm(states[:, part], axis=1) for part in (VELOCITY, ANGULAR))
    fastest = FASTEST_BASE + float(linear[0])  # a rocket may begin with 100
    parts = [(body.name, "m/s", fastest, linear), (body.name, "rad/s", FASTEST_JOINT, angular)]
    for joint, speeds in zip(body.joints, np.abs(states[:, JOINTS + len(body.joints) :]).T, strict=True):
        unit, limit = ("rad/s", FASTEST_JOINT) if joint.is_angle else ("m/s", FASTEST_SLIDE)
        parts.append((f"{joint.name} of {body.name}", unit, limit, speeds))
    for part, unit, limit, speeds in parts if log.actions != "extreme" else ():
        row = int(np.argsort(speeds)[-min(LASTING_STEPS, len(speeds))])
        speed, place = float(speeds[row]), log.places[row]
        if speed > limit and not (unit == "rad/s" and FASTEST_MEANT < speed < NONSENSE):
            message = f"{part} moves at {speed:.4g} {unit} {_when(place)}"
            yield speed, f"{part} {unit}", message, {**place, "value": speed, "expected": f"up to {limit:g}"}


def _thrown(world: LoggedWorld) -> dict[str, Jump]:
    return {jump.body: jump for jump in reversed(world.jumps) if jump.speed > jump.explained + FASTEST_JUMP}


def _unrest(world: LoggedWorld) -> Iterator[RuleFinding]:
    for jump in _thrown(world).values():
        moves = f"{jump.body} moves at {jump.speed:.2f} m/s {jump.after_s:.2g} s after reset, without any action"
        message = f"{moves}; falling explains {jump.explained:.2f} m/s"
        evidence = {"seed": jump.seed, "body": jump.body, "value": jump.speed, "expected": jump.explained}
        yield RuleFinding("RL807", message, evidence)
