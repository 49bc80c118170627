"""RL816: command beyond ctrlrange."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Space

from rlctl.checking.episode import EpisodePlayer, build_action
from rlctl.checking.experiments.worlds import MujocoTrials, WatchedWorlds, judges_trials, judges_worlds
from rlctl.checking.instance import EnvironmentRaised
from rlctl.checking.motor_commands import CommandSpan
from rlctl.checking.motor_trials import MotorTrial
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.rules.rl810_joint_target_in_degrees import find_ranges_in_degrees, find_targets_in_degrees
from rlctl.checking.rules.rl811_joint_targets_in_another_order import find_other_orders
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import Array, Joint, JointActuator

RULE = Rule(
    "RL816",
    "command beyond ctrlrange",
    Severity.WARNING,
    meaning="""
        Actions of the space give an actuator of MuJoCo more than its ctrlrange, to which MuJoCo clamps it
        silently. Different actions then do the same, and exploration at the ends of the range is lost. So it is
        with a command that each action changes and nothing clips, also in PyBullet, where a target leaves the
        limits of its joint: when the action turns round, nothing happens until the command is back. And so it is
        with a position that most actions put beyond the limits of its joint, which then stays at its stop.
    """,
    fix="""
        Scale the action to the actuator's range, low + (action + 1) / 2 * (high - low), from
        model.actuator_ctrlrange.
    """,
    shows_one=True,
)

OUTSIDE, FEWEST_TARGETS = 0.75, 30  # part of the targets that a joint cannot reach, and how many are looked at
TURN = (
    "Turn its sign, shift or scale it: the target has to lie between the joint's limits, in the direction of its own "
    "axis."
)
BulletJoint = tuple[int, int, int]
"""Client, body and joint."""
LONGEST_HOLD, TURNED = 200, 30  # steps of one action, and then of its opposite
SHORTEST_HOLD = 10
FIRST_HOLD = 8  # steps in which a command that is kept changes
BEYOND, FEWEST_STUCK = 0.05, 3  # part of a motor's range; steps in which the opposite action changes nothing
MOVE = 0.03  # of all joints, to see whether a command follows them [rad], [m], [rad/s], [m/s]
CLIP = "Clip the command that is kept from step to step to model.actuator_ctrlrange, in the order of ctrl."
CLIP_BULLET = "Clip the target that is kept from step to step to the limits that getJointInfo gives of its joint."


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for world, spans in watched.driven:
        in_degrees = find_targets_in_degrees(world, watched.calls) or list(find_ranges_in_degrees(spans))
        if not in_degrees and not find_other_orders(world, spans):
            yield from list(_find_clamped(spans)) or _find_outside(world)


@judges_trials(RULE, place=50)
def _judge_trials(trials: MujocoTrials) -> Iterator[RuleFinding]:
    trial = MotorTrial(trials.instance, trials.calls, trials.reader.world.motors)
    if trial.motors and not {"RL810", "RL811", RULE.id} & set(trials.found):
        yield from _find_kept_commands(trial)


def _find_kept_commands(trial: MotorTrial) -> Iterator[RuleFinding]:
    """Yield a command that a held action brings beyond its motor's range, and that stays there for some steps when the
    action turns round."""
    for which, action, opposite in list_ends(trial.instance.env.action_space):
        kept = _find_kept_motors(trial, action)
        if not kept:
            continue
        held = trial.play(FIRST_SEED, [action] * LONGEST_HOLD)
        steps = len(held.calls) - 1 - TURNED
        last = held.read_first(steps) if steps >= SHORTEST_HOLD else None
        beyond = {} if last is None else _find_beyond(trial.motors, last)
        beyond = {motor: bounds for motor, bounds in beyond.items() if motor in kept}
        if last is None or not beyond:
            continue
        turned = trial.play(FIRST_SEED, [action] * steps + [opposite] * TURNED)
        later = [turned.read_first(step) for step in range(steps + 1, len(turned.calls))]
        stuck = {motor: _count_stuck(later, motor, *bounds) for motor, bounds in beyond.items()}
        motor = max(stuck, key=lambda motor: stuck[motor])
        if stuck[motor] >= FEWEST_STUCK:
            yield _describe_kept(trial.motors[motor], float(last[motor]), which, steps, stuck[motor])
            return


def _find_kept_motors(trial: MotorTrial, action: Any) -> set[int]:
    """Return the motors whose command changes while an action is held; without forces that follow the joints, as those
    of a controller do."""
    actions = [action] * FIRST_HOLD
    plain = trial.play(FIRST_SEED, actions)
    early, late = plain.read_first(FIRST_HOLD // 2), plain.read_first(FIRST_HOLD)
    if early is None or late is None:
        return set()
    kept = {motor for motor in range(len(trial.motors)) if early[motor] != late[motor]}
    if all(trial.motors[motor].holds_position for motor in kept):
        return kept
    positions, speeds, size = trial.find_places()
    move = np.zeros(size)
    move[np.concatenate([positions, speeds])] = MOVE
    moved = trial.play(FIRST_SEED, actions, after=plain.calls[0], move=move).read_first(FIRST_HOLD)
    if moved is None:
        return set()
    return {motor for motor in kept if trial.motors[motor].holds_position or moved[motor] == late[motor]}


def list_ends(space: Space[Any]) -> list[tuple[str, Any, Any]]:
    """Return both ends of an action space: its name, the action, and the opposite one."""
    highest, lowest = build_action(space, lambda leaf: leaf.high), build_action(space, lambda leaf: leaf.low)
    return [("highest", highest, lowest), ("lowest", lowest, highest)]


@judges_worlds(RULE, place=93)
def _judge_bullet(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    """Yield a position target in PyBullet that a held action brings beyond its joint's limits, and that stays there for
    some steps when the action turns round."""
    if watched.low.size == 0 or not watched.instance.accepts_seed or not watched.calls.targets:
        return
    for which, action, opposite in list_ends(watched.instance.env.action_space):
        try:
            first = _play_targets(watched, [action] * FIRST_HOLD)
            if len(first) < FIRST_HOLD or first[-1] == first[FIRST_HOLD // 2]:
                continue
            held = _play_targets(watched, [action] * LONGEST_HOLD)
            steps = len(held) - TURNED
            beyond = _find_beyond_limits(watched, held[steps - 1]) if steps >= SHORTEST_HOLD else {}
            turned = _play_targets(watched, [action] * steps + [opposite] * TURNED) if beyond else []
        except EnvironmentRaised:  # an episode that was logged raised it too
            return
        for key, joint in beyond.items():
            kept = [joint.low <= targets[key] <= joint.high for targets in turned[steps:] if key in targets]
            stuck = kept.index(True) if True in kept else len(kept)
            if stuck >= FEWEST_STUCK:
                value = held[steps - 1][key]
                what = f"the {which} action, held for {steps} steps, brings the target of joint {joint.name} to"
                range_ = f"{value:.4g}; its limits are [{joint.low:.4g}, {joint.high:.4g}]"
                message = f"{what} {range_}: the opposite action then changes nothing for {stuck} steps"
                evidence = {"seed": FIRST_SEED, "step": steps, "element": joint.name, "value": value}
                evidence |= {"expected": [joint.low, joint.high]}
                yield RuleFinding(RULE, message, evidence, fix=CLIP_BULLET)
                return


def _play_targets(watched: WatchedWorlds, actions: Sequence[Any]) -> list[dict[BulletJoint, float]]:
    """Play an episode with given actions; return the last position target of each motor after each step."""
    player = EpisodePlayer(watched.instance, FIRST_SEED, "held", max_steps=len(actions), sequence=actions)
    targets = []
    for moment in player:
        if moment.step:
            targets.append({key: given.value for key, given in watched.calls.targets.items()})
        else:
            watched.calls.targets.clear()
    return targets


def _find_beyond_limits(watched: WatchedWorlds, targets: Mapping[BulletJoint, float]) -> dict[BulletJoint, Joint]:
    """Return the joints with a position target far beyond their limits."""
    joints = {
        (world.reader.world.client, body.id, joint.index): joint
        for world in watched.worlds
        for body in world.reader.world.bodies
        for joint in body.joints
        if joint.has_limits
    }
    return {
        key: joints[key]
        for key, value in targets.items()
        if key in joints
        and max(joints[key].low - value, value - joints[key].high) > BEYOND * (joints[key].high - joints[key].low)
    }


def _find_beyond(motors: Sequence[JointActuator], commands: Array) -> dict[int, tuple[float, float]]:
    """Return the motors with a command far beyond their range, and the range."""
    beyond = {}
    for number, (motor, command) in enumerate(zip(motors, commands.tolist(), strict=True)):
        width = motor.high - motor.low
        if np.isfinite(width) and max(motor.low - command, command - motor.high) > BEYOND * width:
            beyond[number] = (motor.low, motor.high)
    return beyond


def _count_stuck(commands: Sequence[Array | None], motor: int, low: float, high: float) -> int:
    inside = [command is None or low <= command[motor] <= high for command in commands]
    return inside.index(True) if True in inside else len(inside)


def _describe_kept(motor: JointActuator, target: float, which: str, steps: int, stuck: int) -> RuleFinding:
    what = f"the {which} action, held for {steps} steps, brings ctrl[{motor.number}] ({motor.name}) to {target:.4g}"
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
        target = f"ctrl[{span.motor.number}] ({span.motor.name})"
        what = f"action[{span.element}] sets {target} to [{span.low:.4g}, {span.high:.4g}]"
        range_ = f"its ctrlrange is [{span.motor.low:.4g}, {span.motor.high:.4g}], to which MuJoCo clamps it silently"
        others = [other.motor.name for _, other in clamped if other is not span]
        more = f"; so for {list_names(others)}" if others else ""
        message = f"{what}; {range_}: only {100 * inside:.0f} % of the action's range has an effect of its own{more}"
        evidence = {"element": f"action[{span.element}]", "value": [span.low, span.high]}
        yield RuleFinding(RULE, message, {**evidence, "expected": [span.motor.low, span.motor.high]})


def _find_outside(world: LoggedWorld) -> Iterator[RuleFinding]:
    """Yield a joint that most random actions give a target beyond its limits."""
    logs = [log for log in world.logs if log.actions == "random"]
    for body in world.world.bodies:
        for joint in body.joints:
            given = [targets.get((body.id, joint.index)) for log in logs for targets in log.targets[1:]]
            values = np.array([target.value for target in given if target is not None])
            if not joint.has_limits or len(values) < FEWEST_TARGETS or np.ptp(values) == 0:
                continue
            outside = float(((values < joint.low) | (values > joint.high)).mean())
            if outside > OUTSIDE:
                low, high = float(values.min()), float(values.max())
                message = f"random actions set the target of joint {joint.name} to [{low:.4g}, {high:.4g}]; its limits"
                message += f" are [{joint.low:.4g}, {joint.high:.4g}]: it is told to go beyond them in"
                message += f" {100 * outside:.0f} % of the steps, and stays at its stop"
                evidence = {"element": joint.name, "value": [low, high], "expected": [joint.low, joint.high]}
                yield RuleFinding(RULE, message, evidence, fix=TURN)
                return
