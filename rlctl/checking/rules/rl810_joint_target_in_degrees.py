"""RL810: joint target in degrees."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.angle_mistakes import AngleMistakes, find_first
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.worlds import ObservedWorld, WatchedWorlds, judges_worlds
from rlctl.checking.joint_copies import DEGREES
from rlctl.checking.motor_commands import CommandSpan
from rlctl.checking.motor_targets import APART, DEGREE, ROUNDED, covers, read_first_targets
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names, list_others
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import JOINTS, JointActuator, JointKey, MotorTarget
from rlctl.environments.bullet_calls import FULL_TURN, BulletCalls

RULE = Rule(
    "RL810",
    "joint target in degrees",
    Severity.ERROR,
    meaning="""
        A position for a revolute joint is in degrees: it is outside its limits by more than three times their
        range and by more than a full turn, or it is the joint's position at reset as degrees, or the action
        covers the joint's range times 57.3 or divided by it. PyBullet and MuJoCo expect radians; the degrees of
        a MuJoCo compiler are converted when the model is loaded, and model.jnt_range has radians. The ctrlrange of
        a position actuator in the XML is not converted.
    """,
    fix="""
        Convert with np.deg2rad, and clip targets to the joint's limits; do not convert what is read from the
        model.
    """,
    shows_one=True,
)

FAR_RANGES = 3.0  # a target farther outside the limits is not just out of reach
XML_FIX = (
    "In the XML, write ctrlrange in radians, whatever its compiler's angle is: a joint's range is converted, ctrlrange "
    'is not (inheritrange="1" takes the converted range). Both differ by gear; kp and kv are per radian.'
)


@judges_expressions(RULE, decides=False)
def _find_given_degrees(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    yield from find_first(RULE, noted.share(AngleMistakes).of_targets)


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for world, spans in watched.driven:
        targets = find_targets_in_degrees(world, watched.calls)
        motors = _find_motors_in_degrees(world)
        uses_range = any(_covers_input(span) for span in spans if span.motor in motors)
        if motors:
            yield _describe_ctrlranges(motors, Severity.ERROR if uses_range else Severity.WARNING)
        if targets and not uses_range:
            yield from targets
        if not motors and not targets:
            yield from find_ranges_in_degrees(spans)
    for one in watched.observed:
        yield from _find_shrunk_copies(one)


def find_targets_in_degrees(world: LoggedWorld, calls: BulletCalls) -> list[RuleFinding]:
    """Return the first target, if any, that is in degrees: other rules then say nothing of the motors."""
    return [*_find_far_targets(world, calls), *_find_unlike_positions(world)][:1]


def _joints(world: LoggedWorld) -> dict[JointKey, tuple[str, bool, float, float]]:
    """Return name, whether it has limits and is an angle, and the limits of each joint."""
    joints = [(body, joint) for body in world.world.bodies for joint in body.joints]
    return {(b.id, j.index): (j.name, j.is_angle and j.has_limits, j.low, j.high) for b, j in joints}


def _find_far_targets(world: LoggedWorld, calls: BulletCalls) -> Iterator[RuleFinding]:
    joints = _joints(world)
    far: dict[str, tuple[MotorTarget, float, float]] = {}
    for key, target in _list_positions(world, calls):
        name, has_limits, low, high = joints.get(key, ("", False, 0.0, 0.0))
        if has_limits and _is_far(target.value, low, high):
            far.setdefault(name, (target, low, high))
    for name, (target, low, high) in list(far.items())[:1]:
        limits = f"its limits are [{low:.3g}, {high:.3g}] rad: degrees?"
        message = f"{target.giver} gives joint {name} the position {target.value:.4g} rad; {limits}"
        evidence = {"element": name, "value": target.value, "expected": [low, high]}
        yield RuleFinding(RULE, message + list_others(list(far)), evidence, where=target.where)


def _is_far(value: float, low: float, high: float) -> bool:
    """Say whether a position is so far outside of limits, and so many turns, that it can only be in degrees."""
    return max(low - value, value - high) > FAR_RANGES * (high - low) and abs(value) > FULL_TURN


def _find_motors_in_degrees(world: LoggedWorld) -> list[JointActuator]:
    """Return the actuators whose range is that of their joint in degrees, or a part of it: MuJoCo converts the joint's
    range, and not the other."""
    motors = []
    for motor in world.world.motors:
        joint, width = motor.joint, motor.high - motor.low
        if not (motor.holds_position and joint.is_angle and joint.has_limits and math.isfinite(width)):
            continue
        limits = np.sort([joint.low * motor.gear, joint.high * motor.gear])
        in_degrees = np.degrees(limits)
        is_equal = np.abs(in_degrees - [motor.low, motor.high]).max() <= ROUNDED * width
        is_inside = motor.low >= in_degrees[0] - ROUNDED * width and motor.high <= in_degrees[1] + ROUNDED * width
        is_far = any(_is_far(end, *limits.tolist()) for end in (motor.low, motor.high))
        if is_equal or (is_inside and is_far):
            motors.append(motor)
    return motors


def _covers_input(span: CommandSpan) -> bool:
    """Say whether actions cover the range that an actuator declares."""
    motor = span.motor
    ends = np.abs(np.subtract([span.low, span.high], [motor.low, motor.high]))
    return bool(ends.max() <= ROUNDED * (motor.high - motor.low))


def _describe_ctrlranges(motors: Sequence[JointActuator], severity: Severity) -> RuleFinding:
    first, joint = motors[0], motors[0].joint
    limits = f"the limits of joint {joint.name} are [{joint.low:.3g}, {joint.high:.3g}] rad"
    others = list_others([motor.name for motor in motors], most=8)
    message = f"ctrlrange of actuator {first.name} is [{first.low:.4g}, {first.high:.4g}], in degrees{others}; {limits}"
    evidence = {
        "element": first.name,
        "elements": [motor.name for motor in motors][:8],
        "value": [first.low, first.high],
        "expected": [joint.low * first.gear, joint.high * first.gear],
    }
    return RuleFinding(RULE, message, evidence, severity, fix=XML_FIX)


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


def _find_unlike_positions(world: LoggedWorld) -> Iterator[RuleFinding]:
    """Yield a target of the zero action that is where its joint is at reset, in degrees."""
    for _, names, means, targets, _, error in read_first_targets(world):
        values = np.array([target.value for target in targets])
        bent = np.abs(means) > max(APART, 5 * error)
        if bent.sum() >= 2 and (np.abs(values[bent] * DEGREE / means[bent] - 1) < 0.2).all():
            joint = int(np.flatnonzero(bent)[0])
            what = f"{targets[joint].giver} gives joint {names[joint]} the position {values[joint]:.4g} rad"
            message = f"with the zero action {what}; it is at {means[joint]:.3g} rad, which is so many degrees"
            evidence = {"element": names[joint], "value": float(values[joint]), "expected": float(means[joint])}
            yield RuleFinding(RULE, message, evidence, where=targets[joint].where)
            return


def find_ranges_in_degrees(spans: Sequence[CommandSpan]) -> Iterator[RuleFinding]:
    """Yield a motor that the action drives over its joint's limits times 57.3, or divided by it."""
    for factor, what in ((DEGREE, "were taken for degrees"), (1 / DEGREE, "were converted to degrees")):
        found = [
            span
            for span in spans
            if span.motor.holds_position
            and span.motor.joint.is_angle
            and span.motor.joint.has_limits
            and covers(span, span.motor, factor)
        ]
        if found:
            span, joint = found[0], found[0].motor.joint
            names = list_names([other.motor.joint.name for other in found])
            limits = f"the limits of joint {joint.name}, [{joint.low:.3g}, {joint.high:.3g}] rad, {what}"
            drives = f"action[{span.element}] drives ctrl[{span.motor.number}] over [{span.low:.4g}, {span.high:.4g}]"
            message = f"{drives}: {limits}"
            evidence = {"element": joint.name, "value": [span.low, span.high], "expected": [joint.low, joint.high]}
            yield RuleFinding(RULE, f"{message} (so are those of {names})" if len(found) > 1 else message, evidence)
            return


def _find_shrunk_copies(one: ObservedWorld) -> Iterator[RuleFinding]:
    """Yield a joint's position in the observation that was converted although it was in radians."""
    shrunk = [copy for copy in one.copies if copy.is_scaled(1 / DEGREES) and not copy.is_speed]
    for copy in shrunk[:1]:
        name = one.name_element(copy.column)
        others = list_others([one.name_element(other.column) for other in shrunk])
        message = f"{name} is {copy.name} times pi / 180{others}: it was in radians already"
        yield RuleFinding(RULE, message, {"element": name, "value": copy.joint.name, "expected": "radians"})
