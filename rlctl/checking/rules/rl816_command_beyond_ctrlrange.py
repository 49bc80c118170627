"""RL816: command beyond ctrlrange."""

import math
from collections.abc import Iterator, Sequence

from rlctl.checking.episode import build_action
from rlctl.checking.experiments.worlds import MujocoTrials, WatchedWorlds, judges_trials, judges_worlds
from rlctl.checking.motor_commands import CommandSpan
from rlctl.checking.motor_trials import MotorTrial
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.rules.rl810_joint_target_in_degrees import find_ranges_in_degrees, find_targets_in_degrees
from rlctl.checking.rules.rl811_joint_targets_in_another_order import find_other_orders
from rlctl.checking.worlds import Array, JointActuator

RULE = Rule(
    "RL816",
    "command beyond ctrlrange",
    Severity.WARNING,
    meaning="""
        Actions of the space give an actuator of MuJoCo more than its ctrlrange, to which MuJoCo clamps it
        silently. Different actions then do the same, and exploration at the ends of the range is lost.
    """,
    fix="""
        Scale the action to the actuator's range, low + (action + 1) / 2 * (high - low), from
        model.actuator_ctrlrange.
    """,
    shows_one=True,
)

LONGEST_HOLD, TURNED = 200, 30  # steps of one action, and then of its opposite
SHORTEST_HOLD = 10
BEYOND, FEWEST_STUCK = 0.05, 3  # part of a motor's range; steps in which the opposite action changes nothing
CLIP = "Clip the target that is kept from step to step to model.actuator_ctrlrange, in the order of ctrl."


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for world, spans in watched.driven:
        in_degrees = find_targets_in_degrees(world, watched.calls) or list(find_ranges_in_degrees(spans))
        if not in_degrees and not find_other_orders(world, spans):
            yield from _find_clamped(spans)


@judges_trials(RULE, place=50)
def _judge_trials(trials: MujocoTrials) -> Iterator[RuleFinding]:
    trial = MotorTrial(trials.instance, trials.calls, trials.reader.world.motors)
    holds_position = any(motor.holds_position for motor in trial.motors)
    if holds_position and not {"RL810", "RL811", RULE.id} & set(trials.found):
        yield from _find_kept_targets(trial)


def _find_kept_targets(trial: MotorTrial) -> Iterator[RuleFinding]:
    """Yield a position target that a held action brings beyond its motor's range, and that stays there for some steps
    when the action turns round."""
    space = trial.instance.env.action_space
    highest, lowest = build_action(space, lambda leaf: leaf.high), build_action(space, lambda leaf: leaf.low)
    for which, action, opposite in (("highest", highest, lowest), ("lowest", lowest, highest)):
        held = trial.play(FIRST_SEED, [action] * LONGEST_HOLD)
        steps = len(held.calls) - 1 - TURNED
        last = held.read_first(steps) if steps >= SHORTEST_HOLD else None
        if last is None or not (beyond := _find_beyond(trial.motors, last)):
            continue
        turned = trial.play(FIRST_SEED, [action] * steps + [opposite] * TURNED)
        later = [turned.read_first(step) for step in range(steps + 1, len(turned.calls))]
        stuck = {motor: _count_stuck(later, motor, *bounds) for motor, bounds in beyond.items()}
        motor = max(stuck, key=lambda motor: stuck[motor])
        if stuck[motor] >= FEWEST_STUCK:
            yield _describe_kept(trial.motors[motor], motor, float(last[motor]), which, steps, stuck[motor])
            return


def _find_beyond(motors: Sequence[JointActuator], commands: Array) -> dict[int, tuple[float, float]]:
    """Return the motors with a position target far beyond their range, and the range."""
    beyond = {}
    for number, (motor, command) in enumerate(zip(motors, commands.tolist(), strict=True)):
        width = motor.high - motor.low
        if motor.holds_position and max(motor.low - command, command - motor.high) > BEYOND * width:
            beyond[number] = (motor.low, motor.high)
    return beyond


def _count_stuck(commands: Sequence[Array | None], motor: int, low: float, high: float) -> int:
    inside = [command is None or low <= command[motor] <= high for command in commands]
    return inside.index(True) if True in inside else len(inside)


def _describe_kept(motor: JointActuator, number: int, target: float, which: str, steps: int, stuck: int) -> RuleFinding:
    what = (
        f"the {which} action, held for {steps} steps, brings the target ctrl[{number}] ({motor.name}) to {target:.4g}"
    )
    range_ = f"its ctrlrange is [{motor.low:.4g}, {motor.high:.4g}], to which MuJoCo clamps it silently"
    message = f"{what}; {range_}: the opposite action then changes nothing for {stuck} steps"
    evidence = {"seed": FIRST_SEED, "step": steps, "element": motor.name, "value": target}
    return RuleFinding(RULE, message, {**evidence, "expected": [motor.low, motor.high]}, fix=CLIP)


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
        yield RuleFinding(RULE, message, {**evidence, "expected": [span.motor.low, span.motor.high]})
