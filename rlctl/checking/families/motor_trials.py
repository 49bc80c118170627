"""RL811 and RL816 of MuJoCo: which motor answers where a joint starts, and a joint that is moved, and a held action."""

import dataclasses
import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer, build_action, zero_action
from rlctl.checking.instance import Instance
from rlctl.checking.mujoco_calls import MujocoCalls
from rlctl.checking.mujoco_worlds import MujocoStateReader, library
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import RuleFinding, list_names
from rlctl.checking.worlds import Array, Joint, Motor
from rlctl.environments.info import find_mujoco

SEEDS = 12  # resets that are compared with the first commands
EQUAL = 1e-6  # relative; float32 targets of float64 positions
DRAWN = 1e-3  # least standard deviation of a start position that is compared [rad], [m]
MOMENTS = (0, 1, 4, 9)  # steps after which a joint is moved: a command may be clipped at one of them
MOVES = (0.01, 0.3, -0.3, 1.0, -1.0, 2.0, -2.0)
"""By so much a joint is moved [rad], [m], or its speed changed [rad/s], [m/s]: by more, where a command
that is clipped does not answer."""
LONGEST_HOLD, TURNED = 200, 30  # steps of one action, and then of its opposite
SHORTEST_HOLD = 10
BEYOND, FEWEST_STUCK = 0.05, 3  # part of a motor's range; steps in which the opposite action changes nothing
CLIP = "Clip the target that is kept from step to step to model.actuator_ctrlrange, in the order of ctrl."


def find_wrong_answers(
    instance: Instance, calls: MujocoCalls, reader: MujocoStateReader, known: Collection[str]
) -> Iterator[RuleFinding]:
    """Yield motors that answer another joint's start or motion, and targets that are kept beyond a motor's range.

    `known` are the rules that have findings about the motors: one mistake is reported once.
    """
    trial = _MotorTrial(instance, calls, reader.world.motors)
    if not trial.motors or {"RL810", "RL811"} & set(known):
        return
    holds_position = any(motor.holds_position for motor in trial.motors)
    orders = list(_find_other_starts(trial)) if holds_position else []
    orders = orders or list(_find_other_feedback(trial))
    yield from orders
    if not orders and holds_position and "RL816" not in known:
        yield from _find_kept_targets(trial)


@dataclasses.dataclass
class _Played:
    """What an episode wrote for the motors, call by call of the physics, and how many calls there were by each step."""

    start: Array  # qpos after reset
    controls: list[Array] = dataclasses.field(default_factory=list)
    calls: list[int] = dataclasses.field(default_factory=list)  # by step; that of reset first

    def read_first(self, step: int) -> Array | None:
        """Return the first command of a step, counted from 1; None if it was not played or called no physics."""
        has_called = len(self.calls) > step and self.calls[step] > self.calls[step - 1]
        return self.controls[self.calls[step - 1]] if has_called else None


class _MotorTrial:
    """Plays episodes in which joints are moved."""

    def __init__(self, instance: Instance, calls: MujocoCalls, motors: Sequence[Motor]) -> None:
        self.instance, self.motors, self._calls = instance, motors, calls
        self.joints: list[Joint] = list({motor.joint.index: motor.joint for motor in motors}.values())
        numbers = [joint.index for joint in self.joints]
        self.own = [numbers.index(motor.joint.index) for motor in motors]  # the place of each motor's joint

    def is_over(self) -> bool:
        """Say whether time ran out."""
        return self.instance.context.budget.is_over()

    def play(
        self, seed: int, actions: Sequence[Any] | None = None, steps: int = 0, after: int = 0, move: Array | None = None
    ) -> _Played:
        """Play an episode of given actions, or of so many random ones. After a number of calls of the physics,
        positions and speeds change by `move`, shape (nq + nv,)."""
        played = _Played(np.zeros(0))
        done = 0

        def note(_: Any, data: Any, nstep: int) -> None:
            played.controls.append(data.ctrl.copy())

        def change(model: Any, data: Any) -> None:
            if move is not None and done == after:
                data.qpos[:] += move[: model.nq]
                data.qvel[:] += move[model.nq :]
                library().mj_forward(model, data)

        def count(model: Any, data: Any) -> None:
            nonlocal done
            done += 1
            change(model, data)

        self._calls.before_step, self._calls.after_step = note, count
        try:
            steps = steps if actions is None else len(actions)
            for moment in EpisodePlayer(self.instance, seed, max_steps=steps, sequence=actions):
                simulation = find_mujoco(self.instance.env)
                if moment.step == 0 and simulation is not None:
                    played.start = simulation[1].qpos.copy()
                    if done == 0:  # no step of the physics in reset, after which joints could be moved
                        change(*simulation)
                played.calls.append(done)
        finally:
            self._calls.before_step, self._calls.after_step = MujocoCalls.before_step, MujocoCalls.after_step
        return played

    def find_places(self) -> tuple[NDArray[np.intp], NDArray[np.intp], int]:
        """Return where in `move` the positions and the speeds of the joints are, and its size."""
        simulation = find_mujoco(self.instance.env)
        assert simulation is not None  # it was played
        model, joints = simulation[0], [joint.index for joint in self.joints]
        return model.jnt_qposadr[joints], model.nq + model.jnt_dofadr[joints], int(model.nq + model.nv)

    def find_exchanged(self, answers: NDArray[np.bool_]) -> dict[int, int]:
        """Return the place of the joint that a motor answers, by motor, where some motors answer each other's joints
        and nothing else. `answers` has a row per motor and a column per joint."""
        rows, columns = answers.sum(axis=1), answers.sum(axis=0)
        single = {m: int(answers[m].argmax()) for m in np.flatnonzero(rows == 1).tolist()}
        other = {m: joint for m, joint in single.items() if joint != self.own[m] and columns[joint] == 1}
        is_closed = {self.own[m] for m in other} == set(other.values())
        return other if len(other) >= 2 and is_closed else {}

    def name_others(self, exchanged: Mapping[int, int]) -> str:
        """Return the motors after the first one, and what they answer."""
        pairs = [f"ctrl[{motor}] that of {self.joints[joint].name}" for motor, joint in exchanged.items()]
        return f"; {list_names(pairs[1:])}"


def _find_other_starts(trial: _MotorTrial) -> Iterator[RuleFinding]:
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
        what = f"with the zero action the first target of joint {own}, ctrl[{motor}], is the start of joint {other}"
        message = f"{what} in all {SEEDS} resets{trial.name_others(exchanged)}"
        start, target = float(starts[0, trial.own[motor]]), float(targets[0, motor])
        evidence = {"seed": FIRST_SEED, "step": 1, "element": own, "value": target, "expected": start}
        yield RuleFinding("RL811", message, evidence)


def _find_other_feedback(trial: _MotorTrial) -> Iterator[RuleFinding]:
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
    trial: _MotorTrial, plain: _Played, places: NDArray[np.intp], size: int, *, is_whole: bool
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


def _is_feedback(motors: Sequence[Motor], answers: Array, exchanged: Mapping[int, int]) -> bool:
    """Say whether forces pull back, as those of a controller do, and targets move with the position that they are
    relative to."""
    signs = [(1 if motors[motor].holds_position else -1) * motors[motor].gear for motor in exchanged]
    return all(sign * answers[pair] > 0 for sign, pair in zip(signs, exchanged.items(), strict=True))


def _describe_feedback(trial: _MotorTrial, exchanged: Mapping[int, int], what: str) -> RuleFinding:
    motor, joint = next(iter(exchanged.items()))
    own, other = trial.motors[motor].joint.name, trial.joints[joint].name
    follows = f"ctrl[{motor}], of the actuator of joint {own}, follows the {what} of joint {other}"
    message = f"{follows}, not of its own joint{trial.name_others(exchanged)}"
    evidence = {"seed": FIRST_SEED, "element": trial.motors[motor].name, "value": other, "expected": own}
    return RuleFinding("RL811", message, evidence)


def _find_kept_targets(trial: _MotorTrial) -> Iterator[RuleFinding]:
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


def _find_beyond(motors: Sequence[Motor], commands: Array) -> dict[int, tuple[float, float]]:
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


def _describe_kept(motor: Motor, number: int, target: float, which: str, steps: int, stuck: int) -> RuleFinding:
    what = (
        f"the {which} action, held for {steps} steps, brings the target ctrl[{number}] ({motor.name}) to {target:.4g}"
    )
    range_ = f"its ctrlrange is [{motor.low:.4g}, {motor.high:.4g}], to which MuJoCo clamps it silently"
    message = f"{what}; {range_}: the opposite action then changes nothing for {stuck} steps"
    evidence = {"seed": FIRST_SEED, "step": steps, "element": motor.name, "value": target}
    return RuleFinding("RL816", message, {**evidence, "expected": [motor.low, motor.high]}, fix=CLIP)
