"""RL708: command winds up."""

import contextlib
import dataclasses
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer, action_at
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.instance import Context, Instance
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.transitions import flatten_floats, name_floats
from rlctl.checking.values import flatten_action, read_attributes
from rlctl.checking.worlds import Array
from rlctl.environments.bullet_calls import BulletCalls, record_calls
from rlctl.environments.info import find_mujoco

RULE = Rule(
    "RL708",
    "command winds up",
    Severity.WARNING,
    meaning="""
        A number adds up the actions without any limit, and what is done with it has one: held at its end, the action
        changes nothing any more, and the number runs on. When the action turns round, nothing happens until the number
        is back, and that takes as long as it ran on: the longer the policy pushes against the limit, the later the
        robot answers. The check held an action, turned it round after some steps and after twice as many, and
        compared.
    """,
    fix="""
        Clip the number that is kept where it is changed, and not only what is sent to the motors: target =
        np.clip(target + step * action, low, high).
    """,
)

RANDOM_STEPS, HELD_STEPS, FEWEST_HELD = 16, 120, 10
FIRST, SECOND = 0.3, 0.6  # parts of the steps that are played after which the action turns round
SAME = 1e-3  # part of the largest change: what float32 makes of an action
USUAL = 0.75  # part of the random steps in which a number follows the action: it may be clipped in others
LAGS = 4  # steps by which what repeats the action may be late
RESTING = 0.02  # part of the largest change before
FEWEST_STUCK, GROWTH = 3, 0.5  # steps in which nothing happens; by how many more for each step that is held longer
SEEDS = (FIRST_SEED, FIRST_SEED + 1)
MOTOR_CALLS = ("setJointMotorControl2", "setJointMotorControlArray")


@dataclasses.dataclass(frozen=True, eq=False)
class _Played:
    """What an episode showed after each step."""

    values: Array  # Observed numbers, and attributes. Shape (steps, numbers)
    commands: Array  # of motors. Shape (steps, commands)
    actions: Array  # Shape (steps, numbers)


@dataclasses.dataclass(frozen=True)
class _Sum:
    """A number that adds up a number of the action."""

    column: int  # of the values
    element: int  # of the action
    factor: float


class _Trials:
    """Plays episodes of given actions."""

    def __init__(self, instance: Instance, calls: BulletCalls) -> None:
        self.instance, self._calls = instance, calls
        self.has_engine = find_mujoco(instance.env) is not None or bool(instance.find_clients())
        self._attributes: dict[str, int] | None = None  # sizes by name, as after the first reset

    def play(self, seed: int, actions: Sequence[Any] | None = None) -> _Played:
        """Play given actions, or some random ones."""
        values, commands, taken = [], [], []
        steps = RANDOM_STEPS if actions is None else len(actions)
        self._calls.targets.clear()
        for moment in EpisodePlayer(self.instance, seed, "random", max_steps=steps, sequence=actions):
            values.append(self._read(moment.observation))
            commands.append(self._read_commands())
            if moment.step:
                taken.append(flatten_action(self.instance.action_leaves, moment.action))
        sizes = [len(row) for row in commands]
        rows = [row if len(row) == max(sizes) else np.full(max(sizes), np.nan) for row in commands]
        return _Played(np.array(values), np.array(rows), np.array(taken))

    def name(self, column: int) -> str:
        """Name one of the values."""
        names = name_floats(self.instance.leaves)
        for name, size in (self._attributes or {}).items():
            names += [name] if size == 1 else [f"{name}[{i}]" for i in range(size)]
        return names[column]

    def _read(self, observation: Any) -> Array:
        attributes = read_attributes(self.instance.env)
        if self._attributes is None:
            self._attributes = {name: one.numbers.size for name, one in attributes.items() if one.numbers.size}
        parts = []
        for name, size in self._attributes.items():
            numbers = attributes[name].numbers if name in attributes else np.zeros(0)
            parts.append(numbers if numbers.size == size else np.full(size, np.nan))
        return np.concatenate([flatten_floats(self.instance.leaves, observation), *parts])

    def _read_commands(self) -> Array:
        simulation = find_mujoco(self.instance.env)
        parts = [np.array([given.value for given in self._calls.targets.values()], np.float64)]
        return np.concatenate([*parts, np.array(simulation[1].ctrl if simulation else [], np.float64)])


@experiment("windup", PROBE, 113, RULE, share=0.3)
def wind_up(context: Context) -> Iterator[ChildMessage]:
    """Hold each number of the action that something adds up."""
    instance = context.instance
    if not instance.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    if any("float" not in leaf.dtype for leaf in instance.action_leaves) or not instance.action_leaves:
        raise NotApplicable("actions are no real numbers")
    with record_calls(with_results=MOTOR_CALLS) if "pybullet" in sys.modules else _no_calls() as calls:
        trials = _Trials(instance, calls)
        played = trials.play(FIRST_SEED)
        sums = _find_sums(played)
        if not sums:
            raise NotApplicable("nothing adds up the actions")
        copies = _find_copies(played)
        for one in sums:
            for end in (1.0, 0.0):
                if context.budget.is_over():
                    raise NotJudged("time ran out")
                found = [_measure(trials, one, end, copies, seed) for seed in SEEDS]
                if all(stuck is not None for stuck in found) and found[0] is not None:
                    yield _describe(trials, one, end, *found[0])
                    return


def _no_calls() -> contextlib.AbstractContextManager[BulletCalls]:
    return contextlib.nullcontext(BulletCalls())


def _find_sums(played: _Played) -> list[_Sum]:
    """Return the numbers that change in each step by a number of the action times a factor."""
    found: list[_Sum] = []
    if len(played.actions) < FEWEST_HELD:
        return found
    changes = np.diff(played.values, axis=0)
    for column in np.flatnonzero(np.isfinite(changes).all(axis=0) & (np.abs(changes).max(axis=0) > 0)).tolist():
        change = changes[:, column]
        for element, numbers in enumerate(played.actions.T):
            large = np.abs(numbers) > 0.1 * np.abs(numbers).max(initial=0.0)
            if not large.any():
                continue
            factor = float(np.median(change[large] / numbers[large]))
            near = np.abs(change - factor * numbers) <= SAME * np.abs(change).max()
            if factor and near.mean() >= USUAL:
                found.append(_Sum(column, element, factor))
    return found


def _find_copies(played: _Played) -> set[int]:
    """Return the numbers that repeat the action, also a few steps late."""
    found: set[int] = set()
    for lag in range(LAGS):
        actions = np.column_stack([played.actions[: len(played.actions) - lag], np.ones(len(played.actions) - lag)])
        rows = np.nan_to_num(played.values[1 + lag :])
        left = rows - actions @ np.linalg.lstsq(actions, rows, rcond=None)[0]
        spread = np.ptp(rows, axis=0)
        found |= set(np.flatnonzero((np.abs(left).max(axis=0) <= SAME * spread) & (spread > 0)).tolist())
    return found


def _measure(
    trials: _Trials, one: _Sum, end: float, copies: set[int], seed: int
) -> tuple[int, int, int, int, float] | None:
    """Return after how many steps the action turned round and for how many nothing happened, twice, and the number
    that had added it up; None where it does not wind up."""
    space = trials.instance.env.action_space
    size = sum(int(np.prod(leaf.shape)) for leaf in trials.instance.action_leaves)
    held_action, turned_action = (
        action_at(space, np.where(np.arange(size) == one.element, part, 0.5)) for part in (end, 1 - end)
    )
    held = trials.play(seed, [held_action] * HELD_STEPS)
    steps = len(held.actions)
    runs = np.diff(held.values[:, one.column])
    wanted = one.factor * held.actions[:, one.element]
    if steps < FEWEST_HELD or np.abs(runs - wanted).max() > SAME * np.abs(wanted).max():
        return None  # it has a limit
    first, second = int(FIRST * steps), int(SECOND * steps)
    rows = held.commands if trials.has_engine else np.delete(held.values, sorted(copies), axis=1)
    followers = _find_followers(rows, first, second, exact=trials.has_engine)
    if not followers.size:
        return None
    stuck = []
    for turn in (first, second):
        turned = trials.play(seed, [held_action] * turn + [turned_action] * (steps - turn))
        others = turned.commands if trials.has_engine else np.delete(turned.values, sorted(copies), axis=1)
        stuck.append(_count_stuck(rows, others, followers, turn))
    # What nothing answers to the end of the episode counts as answered there.
    if stuck[1] < FEWEST_STUCK or stuck[1] - stuck[0] < max(2, GROWTH * (second - first)):
        return None
    return first, stuck[0], second, stuck[1], float(held.values[second, one.column])


def _find_followers(rows: Array, first: int, second: int, *, exact: bool) -> NDArray[np.intp]:
    """Return the columns that moved at first, and then rest while the action is still held."""
    changes = np.abs(np.diff(np.nan_to_num(rows[1:]), axis=0))
    early, late = changes[: first - 1], changes[first - 1 : second - 1]
    if not len(early) or not len(late):
        return np.zeros(0, np.intp)
    most = 0.0 if exact else RESTING
    return np.flatnonzero((early.max(axis=0) > 0) & (late.max(axis=0) <= most * early.max(axis=0)))


def _count_stuck(held: Array, turned: Array, followers: NDArray[np.intp], turn: int) -> int:
    """Return after how many steps with the opposite action something differs from holding it on."""
    length = min(len(held), len(turned))
    differs = (held[turn + 1 : length, followers] != turned[turn + 1 : length, followers]).any(axis=1)
    return int(differs.argmax()) if differs.any() else len(differs)


def _describe(
    trials: _Trials, one: _Sum, end: float, first: int, early: int, second: int, late: int, value: float
) -> RuleFinding:
    name, which = trials.name(one.column), "highest" if end else "lowest"
    message = f"{name} adds up action[{one.element}] without a limit: held at its {which} for {second} steps, it is"
    message += f" {value:.4g}, and the opposite action then changes nothing for {late} steps; for {early} after {first}"
    return RuleFinding(RULE, message, {"element": name, "value": value, "seed": FIRST_SEED, "step": second})
