"""RL811: joint targets in another order."""

import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import zero_action
from rlctl.checking.experiments.worlds import MujocoTrials, WatchedWorlds, judges_trials, judges_worlds
from rlctl.checking.motor_commands import CommandSpan
from rlctl.checking.motor_targets import APART, DEGREE, ROUNDED, covers, read_first_targets
from rlctl.checking.motor_trials import MotorTrial, PlayedMotors
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.rules.rl810_joint_target_in_degrees import find_targets_in_degrees
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import Array, JointActuator

RULE = Rule(
    "RL811",
    "joint targets in another order",
    Severity.ERROR,
    meaning="""
        A motor gets what is meant for another joint: with the zero action the targets are the joint positions
        at reset in another order; or a command follows the position of another joint, or covers the limits of
        another; or the largest forces of motors are those that the model has for other joints. Orders of models and
        policies often differ, by leg or by kind of joint, and MuJoCo's actuators need not be in the order of its
        joints.
    """,
    fix="""
        Look joints up by their names, and use one list of indices for reading states and for setting targets.
        In MuJoCo, model.actuator_trnid[i, 0] is the joint that ctrl[i] moves.
    """,
    shows_one=True,
)

SEEDS = 12  # resets that are compared with the first commands
EQUAL = 1e-6  # relative; float32 targets of float64 positions
DRAWN = 1e-3  # least standard deviation of a start position that is compared [rad], [m]
MOMENTS = (0, 1, 4, 9)  # steps after which a joint is moved: a command may be clipped at one of them
MOVES = (0.01, 0.3, -0.3, 1.0, -1.0, 2.0, -2.0)
"""By so much a joint is moved [rad], [m], or its speed changed [rad/s], [m/s]: by more, where a command
that is clipped does not answer."""
FEWEST_JOINTS = 3
PAIR_ERROR = 0.1  # of the mean positions of two joints that are compared, at most [rad], [m]
NEAR = 0.05  # of sorted targets and positions [rad], [m]


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for world, spans in watched.driven:
        found = [] if find_targets_in_degrees(world, watched.calls) else find_other_orders(world, spans)
        yield from found or _find_other_strengths(world)


def find_other_orders(world: LoggedWorld, spans: Sequence[CommandSpan]) -> list[RuleFinding]:
    """Return what shows that the motors of a world are driven in another order; empty if nothing does."""
    return list(_find_wrong_order(world)) or list(_find_other_ranges(spans))


@judges_trials(RULE, place=40)
def _find_wrong_answers(trials: MujocoTrials) -> Iterator[RuleFinding]:
    trial = MotorTrial(trials.instance, trials.calls, trials.reader.world.motors)
    if not trial.motors or {"RL810", RULE.id} & set(trials.found):
        return
    holds_position = any(motor.holds_position for motor in trial.motors)
    starts = list(_find_other_starts(trial)) if holds_position else []
    yield from starts or _find_other_feedback(trial)


def _find_other_starts(trial: MotorTrial) -> Iterator[RuleFinding]:
    """Yield motors whose first target after a zero action is exactly where another joint starts, in all resets."""
    zero = zero_action(trial.instance.env.action_space)
    episodes = [trial.play(FIRST_SEED + number, [zero]) for number in range(SEEDS) if not trial.is_over()]
    commands = [command for played in episodes if (command := played.read_first(1)) is not None]
    if len(commands) < SEEDS:
        return
    starts = np.array([played.start for played in episodes])[:, trial.find_places()[0]]
    targets = np.array(commands) / [motor.gear for motor in trial.motors]
    is_equal = np.isclose(targets[:, :, None], starts[:, None, :], EQUAL, EQUAL).all(axis=0)
    is_equal &= np.array([motor.holds_position for motor in trial.motors])[:, None] & (starts.std(axis=0) >= DRAWN)
    if exchanged := trial.find_exchanged(is_equal):
        motor, joint = next(iter(exchanged.items()))
        own, other = trial.motors[motor].joint.name, trial.joints[joint].name
        target_of = f"the first target of joint {own}, ctrl[{trial.motors[motor].number}]"
        what = f"with the zero action {target_of}, is the start of joint {other}"
        message = f"{what} in all {SEEDS} resets{trial.name_others(exchanged)}"
        start, target = float(starts[0, trial.own[motor]]), float(targets[0, motor])
        evidence = {"seed": FIRST_SEED, "step": 1, "element": own, "value": target, "expected": start}
        yield RuleFinding(RULE, message, evidence)


def _find_other_feedback(trial: MotorTrial) -> Iterator[RuleFinding]:
    """Yield motors whose command changes when another joint is moved, as that of a position controller does."""
    plain = trial.play(FIRST_SEED, steps=MOMENTS[-1] + 1)
    positions, speeds, size = trial.find_places()
    if not _measure_answer(trial, plain, np.concatenate([positions, speeds]), size, is_whole=False).any():
        return
    for addresses, what in ((positions, "position"), (speeds, "speed")):
        answers = np.zeros((len(trial.motors), len(trial.joints)))
        for is_whole in (False, True):  # first what answers, then whether something else answers too
            for joint in trial.find_exchanged(answers != 0).values() if is_whole else range(len(trial.joints)):
                answers[:, joint] = _measure_answer(trial, plain, addresses[[joint]], size, is_whole=is_whole)
        exchanged = trial.find_exchanged(answers != 0)
        if exchanged and not trial.is_over() and _is_feedback(trial.motors, answers, exchanged):
            yield _describe_feedback(trial, exchanged, what)
            return


def _measure_answer(
    trial: MotorTrial, plain: PlayedMotors, places: NDArray[np.intp], size: int, *, is_whole: bool
) -> Array:
    """Return how the first commands after some joints were moved change, per unit; 0 where they never do. Shape
    (motors,). Stops after the first answer unless `is_whole`."""
    answers = np.zeros(len(trial.motors))
    for change, step in itertools.product(MOVES, MOMENTS):
        before = plain.read_first(step + 1)
        if before is None or trial.is_over() or (answers.any() and not is_whole):
            continue
        move = np.zeros(size)
        move[places] = change
        after = trial.play(FIRST_SEED, steps=step + 1, after=plain.calls[step], move=move).read_first(step + 1)
        if after is not None:
            answers = np.where(answers == 0, np.nan_to_num(after - before) / change, answers)
    return answers


def _is_feedback(motors: Sequence[JointActuator], answers: Array, exchanged: Mapping[int, int]) -> bool:
    """Say whether forces pull back, as those of a controller do, and targets move with the position that they are
    relative to."""
    signs = [(1 if motors[motor].holds_position else -1) * motors[motor].gear for motor in exchanged]
    return all(sign * answers[pair] > 0 for sign, pair in zip(signs, exchanged.items(), strict=True))


def _describe_feedback(trial: MotorTrial, exchanged: Mapping[int, int], what: str) -> RuleFinding:
    motor, joint = next(iter(exchanged.items()))
    own, other = trial.motors[motor].joint.name, trial.joints[joint].name
    follows = f"ctrl[{trial.motors[motor].number}], of the actuator of joint {own}, follows the {what} of joint {other}"
    message = f"{follows}, not of its own joint{trial.name_others(exchanged)}"
    evidence = {"seed": FIRST_SEED, "element": trial.motors[motor].name, "value": other, "expected": own}
    return RuleFinding(RULE, message, evidence)


def _find_wrong_order(world: LoggedWorld) -> Iterator[RuleFinding]:
    for name, joints, means, targets, positions, error in read_first_targets(world):
        values = np.array([target.value for target in targets])
        order = np.argsort(values, kind="stable")
        is_sorted_same = min(
            (np.abs(values[order] - np.sort(at)).max() - allowed for at, allowed in ((means, error), (positions, 0.0))),
        )
        wrong = np.flatnonzero(np.abs(values - means) > max(APART, 3 * error))
        is_known = len(targets) >= FEWEST_JOINTS or error <= PAIR_ERROR
        if is_known and is_sorted_same <= NEAR and wrong.size >= 2:
            index = int(wrong[0])
            what = f"with the zero action the {len(targets)} motor targets of {name} are its joint positions at reset"
            at, value = float(positions[index]), float(values[index])
            message = f"{what} in another order: {joints[index]} is at {at:.3g} and gets {value:.3g}"
            evidence = {"element": joints[index], "value": value, "expected": at}
            yield RuleFinding(RULE, message, evidence, where=targets[index].where)
            return


def _find_other_strengths(world: LoggedWorld) -> Iterator[RuleFinding]:
    """Yield a motor with the strength that the model gives another joint, where two motors have each other's, or all
    are those of the model but for their order."""
    strengths = world.reader.read_strengths()
    for body in world.world.bodies:
        driven = [joint for joint in body.joints if joint.effort > 0 and (body.id, joint.index) in strengths]
        given = np.array([strengths[body.id, joint.index].force for joint in driven])
        efforts = np.array([joint.effort for joint in driven])
        is_effort = np.isclose(given[:, None], efforts[None, :], ROUNDED)  # of the joint of each column
        is_wrong = ~np.diagonal(is_effort)
        exchanged = is_effort & is_effort.T & is_wrong[:, None] & is_wrong[None, :]
        if is_wrong.any() and np.allclose(np.sort(given), np.sort(efforts), ROUNDED):
            exchanged = is_effort & is_wrong[:, None] & is_wrong[None, :]
        if exchanged.any():
            one, other = (int(place) for place in np.argwhere(exchanged)[0])
            joint, has = driven[one], float(given[one])
            unit = "N m" if joint.is_angle else "N"
            what = f"the motors of {body.name} have the largest forces of its model in another order"
            message = f"{what}: {joint.name} gets {has:.4g} {unit}, which the model has for {driven[other].name}, and"
            message += f" {joint.effort:.4g} for {joint.name}"
            evidence = {"element": joint.name, "value": has, "expected": joint.effort}
            yield RuleFinding(RULE, message, evidence, where=strengths[body.id, joint.index].where)
            return


def _find_other_ranges(spans: Sequence[CommandSpan]) -> Iterator[RuleFinding]:
    """Yield a motor that the action drives over the limits of another joint, which differ from those of its own.

    The other's motor, too, has to be driven over limits that are not its own: one range may equal one by chance.
    """
    holding = [span for span in spans if span.motor.holds_position and span.motor.joint.has_limits]
    swapped = []
    for span, other in itertools.permutations(holding, 2):
        if covers(span, other.motor) and not covers(span, span.motor) and not covers(span, span.motor, DEGREE):
            swapped.append((span, other))
    numbers = {span.motor.number for span, _ in swapped}
    in_cycle = [(span, other) for span, other in swapped if other.motor.number in numbers]
    if len({span.motor.number for span, _ in in_cycle}) >= 2:
        span, other = in_cycle[0]
        joint, reach = span.motor.joint, other.motor.joint
        limits = f"over [{span.low:.3g}, {span.high:.3g}], the limits of joint {reach.name}"
        own = f"those of its own joint {joint.name} are [{joint.low:.3g}, {joint.high:.3g}]"
        message = f"action[{span.element}] drives ctrl[{span.motor.number}] {limits}; {own}"
        evidence = {"element": span.motor.name, "value": [span.low, span.high], "expected": [joint.low, joint.high]}
        yield RuleFinding(RULE, message, evidence)
