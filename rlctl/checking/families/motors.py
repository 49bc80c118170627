"""RL810, RL811, RL814 and RL816: what an environment tells the motors of its robots."""

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.motor_commands import CommandSpan, MotorCommands
from rlctl.checking.rule import RuleFinding, Severity, list_names
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import JOINTS, Array, JointKey, Motor, MotorTarget
from rlctl.environments.bullet_calls import FULL_TURN, BulletCalls

FAR_RANGES = 3.0  # a target farther outside the limits is not just out of reach
FEWEST_JOINTS = 3
NEAR, APART = 0.05, 0.2  # of sorted targets and positions; of a target and its own joint's position [rad], [m]
DEGREE = math.pi / 180
ROUNDED = 1e-3  # relative; for what people round
BEYOND = 0.05  # part of a motor's range


def find_wrong_motors(world: LoggedWorld, calls: BulletCalls, low: Array, high: Array) -> Iterator[RuleFinding]:
    """Yield what is wrong with the targets and commands of a world; `low` and `high` bound the action, shape (n,)."""
    in_degrees = [*_find_far_targets(world, calls), *_find_targets_in_degrees(world)][:1]
    yield from in_degrees or _find_ctrlrange_in_degrees(world)
    orders = [] if in_degrees else list(_find_wrong_order(world))
    commands = MotorCommands.read(world, low, high)
    if commands is not None and not in_degrees:
        spans = commands.find_spans()
        in_degrees = list(_find_ranges_in_degrees(spans))
        yield from in_degrees
        orders = orders or list(_find_other_ranges(spans))
        if not in_degrees and not orders:
            yield from _find_clamped(spans)
    yield from orders
    yield from _find_weak_motors(world)


def _joints(world: LoggedWorld) -> dict[JointKey, tuple[str, bool, float, float]]:
    """Return name, whether it has limits and is an angle, and the limits of each joint."""
    joints = [(body, joint) for body in world.world.bodies for joint in body.joints]
    return {(b.id, j.index): (j.name, j.is_angle and j.has_limits, j.low, j.high) for b, j in joints}


def _find_far_targets(world: LoggedWorld, calls: BulletCalls) -> Iterator[RuleFinding]:
    joints = _joints(world)
    for key, target in _list_positions(world, calls):
        name, has_limits, low, high = joints.get(key, ("", False, 0.0, 0.0))
        outside = max(low - target.value, target.value - high)
        if has_limits and outside > FAR_RANGES * (high - low) and abs(target.value) > FULL_TURN:
            limits = f"its limits are [{low:.3g}, {high:.3g}] rad: degrees?"
            message = f"{target.giver} gives joint {name} the position {target.value:.4g} rad; {limits}"
            evidence = {"element": name, "value": target.value, "expected": [low, high]}
            yield RuleFinding("RL810", message, evidence, where=target.where)
            return


def _find_ctrlrange_in_degrees(world: LoggedWorld) -> Iterator[RuleFinding]:
    """Yield an actuator whose range is that of its joint in degrees: MuJoCo converts the joint's, and not the other."""
    for motor in world.world.motors:
        joint, width = motor.joint, motor.high - motor.low
        if motor.holds_position and joint.is_angle and joint.has_limits and math.isfinite(width):
            ends = np.sort(np.degrees([joint.low, joint.high]) * motor.gear)
            if np.abs(ends - [motor.low, motor.high]).max() <= ROUNDED * width:
                limits = f"the limits of joint {joint.name}, [{joint.low:.3g}, {joint.high:.3g}] rad, in degrees"
                message = f"ctrlrange of actuator {motor.name} is [{motor.low:.4g}, {motor.high:.4g}]: {limits}"
                evidence = {"element": motor.name, "value": [motor.low, motor.high]}
                yield RuleFinding("RL810", message, {**evidence, "expected": [joint.low, joint.high]}, Severity.WARNING)
                return


def _list_positions(world: LoggedWorld, calls: BulletCalls) -> Iterator[tuple[JointKey, MotorTarget]]:
    """Yield positions that joints are told to have, or are set to: of PyBullet those of more than a full turn."""
    for far in calls.far_targets:
        if world.world.engine == "PyBullet" and far.client == world.world.client:
            where = far.call.file, far.call.line
            yield (far.body, far.joint), MotorTarget(far.value, far.force, far.call.name, where)
    for log in world.logs if world.world.engine == "MuJoCo" else ():
        for body, states in log.bodies:
            for joint, value in zip(body.joints, states[0, JOINTS:], strict=False):
                yield (body.id, joint.index), MotorTarget(float(value), math.inf, "qpos at reset")
        for targets in log.targets[1:]:
            yield from targets.items()


def _read_first_targets(world: LoggedWorld) -> Iterator[tuple[str, list[str], Array, list[MotorTarget], Array, float]]:
    """Yield, for each robot, its name, and of each driven joint the name, the mean position at reset, the target that
    the first zero action gives it, the position at that reset, and the error of the means."""
    for log in world.logs:
        for i, body in enumerate(log.world.bodies if log.actions == "zero" and len(log.targets) > 1 else ()):
            first = log.targets[1]
            driven = [j for j, joint in enumerate(body.joints) if (body.id, joint.index) in first]
            if not driven:
                continue
            columns = [JOINTS + j for j in driven]
            sizes = [JOINTS + 2 * len(body.joints)] * len(world.logs)
            starts = [other.states[0][i] for other in world.logs if len(other.states[0]) > i]
            rows = np.array([state[columns] for state, size in zip(starts, sizes, strict=False) if len(state) == size])
            error = 4 * float(rows.std(axis=0).max()) / math.sqrt(len(rows))
            targets = [first[body.id, body.joints[j].index] for j in driven]
            names = [body.joints[j].name for j in driven]
            yield body.name, names, rows.mean(axis=0), targets, log.states[0][i][columns], error


def _find_targets_in_degrees(world: LoggedWorld) -> Iterator[RuleFinding]:
    for _, names, means, targets, _, error in _read_first_targets(world):
        values = np.array([target.value for target in targets])
        bent = np.abs(means) > max(APART, 5 * error)
        if bent.sum() >= 2 and (np.abs(values[bent] * DEGREE / means[bent] - 1) < 0.2).all():
            joint = int(np.flatnonzero(bent)[0])
            what = f"{targets[joint].giver} gives joint {names[joint]} the position {values[joint]:.4g} rad"
            message = f"with the zero action {what}; it is at {means[joint]:.3g} rad, which is so many degrees"
            evidence = {"element": names[joint], "value": float(values[joint]), "expected": float(means[joint])}
            yield RuleFinding("RL810", message, evidence, where=targets[joint].where)
            return


def _find_wrong_order(world: LoggedWorld) -> Iterator[RuleFinding]:
    for name, joints, means, targets, positions, error in _read_first_targets(world):
        values = np.array([target.value for target in targets])
        order = np.argsort(values, kind="stable")
        is_sorted_same = min(
            (np.abs(values[order] - np.sort(at)).max() - allowed for at, allowed in ((means, error), (positions, 0.0))),
        )
        wrong = np.flatnonzero(np.abs(values - means) > max(APART, 3 * error))
        if len(targets) >= FEWEST_JOINTS and is_sorted_same <= NEAR and wrong.size >= 2:
            index = int(wrong[0])
            what = f"with the zero action the {len(targets)} motor targets of {name} are its joint positions at reset"
            at, value = float(positions[index]), float(values[index])
            message = f"{what} in another order: {joints[index]} is at {at:.3g} and gets {value:.3g}"
            evidence = {"element": joints[index], "value": value, "expected": at}
            yield RuleFinding("RL811", message, evidence, where=targets[index].where)
            return


def _find_weak_motors(world: LoggedWorld) -> Iterator[RuleFinding]:
    log = world.logs[0]
    for key, needed in log.weights.items() if len(log.targets) > 1 else ():
        target = log.targets[1].get(key)
        if target is not None and 0 < target.force < needed:
            joint = next(j for body in world.world.bodies for j in body.joints if (body.id, j.index) == key)
            unit = "N m" if joint.is_angle else "N"
            holding = f"to hold the weight at reset takes {needed:.4g} {unit}"
            message = f"the motor of {joint.name} has at most {target.force:.4g} {unit}, and {holding}"
            evidence = {"element": joint.name, "value": target.force, "expected": needed}
            yield RuleFinding("RL814", message, evidence, where=target.where)
            return


def _find_other_ranges(spans: Sequence[CommandSpan]) -> Iterator[RuleFinding]:
    """Yield a motor that the action drives over the limits of another joint, which differ from those of its own."""
    holding = [span for span in spans if span.motor.holds_position and span.motor.joint.has_limits]
    swapped = []
    for span, other in itertools.permutations(holding, 2):
        if _covers(span, other.motor) and not _covers(span, span.motor) and not _covers(span, span.motor, DEGREE):
            swapped.append((span, other))
    if len({span.number for span, _ in swapped}) >= 2:
        span, other = swapped[0]
        joint, reach = span.motor.joint, other.motor.joint
        limits = f"over [{span.low:.3g}, {span.high:.3g}], the limits of joint {reach.name}"
        own = f"those of its own joint {joint.name} are [{joint.low:.3g}, {joint.high:.3g}]"
        message = f"action[{span.element}] drives ctrl[{span.number}] {limits}; {own}"
        evidence = {"element": span.motor.name, "value": [span.low, span.high], "expected": [joint.low, joint.high]}
        yield RuleFinding("RL811", message, evidence)


def _covers(span: CommandSpan, motor: Motor, factor: float = 1.0) -> bool:
    """Say whether a span is the limits of a motor's joint times a factor."""
    joint = motor.joint
    ends = np.array([joint.low, joint.high]) * factor * motor.gear
    return bool(np.abs(np.sort(ends) - [span.low, span.high]).max() <= ROUNDED * np.ptp(ends))


def _find_ranges_in_degrees(spans: Sequence[CommandSpan]) -> Iterator[RuleFinding]:
    for factor, what in ((DEGREE, "were taken for degrees"), (1 / DEGREE, "were converted to degrees")):
        found = [
            span
            for span in spans
            if span.motor.holds_position
            and span.motor.joint.is_angle
            and span.motor.joint.has_limits
            and _covers(span, span.motor, factor)
        ]
        if found:
            span, joint = found[0], found[0].motor.joint
            names = list_names([other.motor.joint.name for other in found])
            limits = f"the limits of joint {joint.name}, [{joint.low:.3g}, {joint.high:.3g}] rad, {what}"
            message = (
                f"action[{span.element}] drives ctrl[{span.number}] over [{span.low:.4g}, {span.high:.4g}]: {limits}"
            )
            evidence = {"element": joint.name, "value": [span.low, span.high], "expected": [joint.low, joint.high]}
            yield RuleFinding("RL810", f"{message} (so are those of {names})" if len(found) > 1 else message, evidence)
            return


def _find_clamped(spans: Sequence[CommandSpan]) -> Iterator[RuleFinding]:
    clamped = []
    for span in spans:
        motor, width = span.motor, span.motor.high - span.motor.low
        over = max(motor.low - span.low, span.high - motor.high)
        if math.isfinite(width) and over > BEYOND * width:
            inside = max(0.0, min(span.high, motor.high) - max(span.low, motor.low)) / (span.high - span.low)
            clamped.append((inside, span))
    if clamped:
        inside, span = min(clamped, key=lambda pair: pair[0])
        what = (
            f"action[{span.element}] sets ctrl[{span.number}] ({span.motor.name}) to [{span.low:.4g}, {span.high:.4g}]"
        )
        range_ = f"its ctrlrange is [{span.motor.low:.4g}, {span.motor.high:.4g}], to which MuJoCo clamps it silently"
        others = [other.motor.name for _, other in clamped if other is not span]
        more = f"; so for {list_names(others)}" if others else ""
        message = f"{what}; {range_}: only {100 * inside:.0f} % of the action's range has an effect of its own{more}"
        evidence = {"element": f"action[{span.element}]", "value": [span.low, span.high]}
        yield RuleFinding("RL816", message, {**evidence, "expected": [span.motor.low, span.motor.high]})
