"""The experiment `batches`: plays several worlds of a `BatchTask`, for rules about what goes wrong only then."""

import copy
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiment import INSTANCES, JudgeHook, experiment
from rlctl.checking.instance import Context, EnvironmentRaised, Instance
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped
from rlctl.checking.rule import NotApplicable, NotJudged
from rlctl.checking.values import NUMBERS, find_batch
from rlctl.errors import WorldFailed

WORLDS, COMPARED = 4, 1  # worlds, and the one whose episode is compared
STEPS = 12
LATER = 4  # an attribute gets another value after so many steps
MOST_NUMBERS = 10_000  # in an attribute; more are a table
WIDEST = 10.0  # of the range of actions without limits
Rows = NDArray[np.float64]


@dataclasses.dataclass
class PlayedWorlds:
    """What the worlds gave: observation, reward and whether the episode terminated, of the reset and of each step."""

    rows: list[Rows]  # shape (worlds, size + 2) each
    attributes: list[dict[str, Any]]  # numbers that the task holds after each of them, by name


def are_equal(one: PlayedWorlds, two: PlayedWorlds) -> bool:
    """Say whether the worlds gave the same, to the bit."""
    pairs = zip(one.rows, two.rows, strict=False)
    return len(one.rows) == len(two.rows) and all(np.array_equal(*pair, equal_nan=True) for pair in pairs)


judges_batches = JudgeHook["SeveralWorlds"]()
"""Shows several worlds of a task, which the parts reset and play."""
judges_failures = JudgeHook[EnvironmentRaised]()
"""Shows what several worlds raised, and one world did not."""


@experiment("batches", INSTANCES, 30, hooks=(judges_batches, judges_failures))
def compare_worlds(context: Context) -> Iterator[ChildMessage]:
    """Play a few steps with one world and with several, whose seeds and actions change."""
    with context.fresh() as instance:
        task = find_batch(instance.env)
        if task is None:
            raise NotApplicable("it is no BatchTask, whose worlds are simulated together")
        try:
            alone = _play_alone(instance)
        except EnvironmentRaised as error:
            raise NotJudged(f"an episode of one world failed: {error}") from None
        try:
            yield from judges_batches.judge(SeveralWorlds(instance, context, alone))
        except EnvironmentRaised as error:
            if isinstance(error.cause, WorldFailed):
                raise NotJudged(f"an episode failed: {error}") from None
            yield from judges_failures.judge(error)
            for rule in judges_batches.decided:
                yield Skipped(rule, f"it fails with {WORLDS} worlds (RL408)")


def choose_actions(space: Any, seed: int) -> NDArray[Any]:
    """Return random actions for the steps of an episode. Shape (STEPS, *space.shape)."""
    low, high = np.maximum(space.low, -WIDEST), np.minimum(space.high, WIDEST)
    return np.random.default_rng(seed).uniform(low, high, (STEPS, *space.shape)).astype(space.dtype)


def _play_alone(instance: Instance) -> Rows:
    """Return the rows of one world, shape (steps + 1, size + 2), up to the end of its episode."""
    observation, _ = instance.reset(FIRST_SEED + COMPARED)
    rows = [np.array([*observation, 0.0, False])]
    for step, action in enumerate(choose_actions(instance.env.action_space, COMPARED), start=1):
        observation, reward, terminated, truncated, _ = instance.call("step", instance.env.step, action, step=step)
        rows.append(np.array([*observation, reward, terminated]))
        if terminated or truncated:
            break
    return np.array(rows)


class SeveralWorlds:
    """Several worlds of the task, which are called as the environment itself is."""

    def __init__(self, instance: Instance, context: Context, alone: Rows) -> None:
        self._instance = instance
        self.alone = alone  # What one world alone gave. Shape (steps + 1, size + 2)
        self.env: Any = instance.call("build", context.spec.make_worlds, WORLDS)
        self.names = list(instance.env.unwrapped.observation_sizes.items())
        task = self.env.task
        self._excluded = {*task.per_world, *type(task).parameters(), "worlds"}

    def reset(self, worlds: Sequence[int], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Reset some worlds."""
        first: NDArray[np.float32] = self._instance.call("reset", self.env.reset, np.array(worlds), seeds)
        return first

    def play(self, others: int = 0, replaced: dict[str, Any] | None = None) -> PlayedWorlds:
        """Play until an episode ends; `others` changes the seeds and actions of all worlds but the compared one.

        `replaced` has attributes of the task to set after `LATER` steps.
        """
        numbers = [world if world == COMPARED else world + others for world in range(WORLDS)]
        actions = np.stack([choose_actions(self.env.task.action_space, number) for number in numbers], axis=1)
        first = self.reset(range(WORLDS), [FIRST_SEED + number for number in numbers])
        played = PlayedWorlds([np.hstack([first, np.zeros((WORLDS, 2))])], [self._read_attributes()])
        for step, action in enumerate(actions, start=1):
            result = self._instance.call("step", self.env.step, action, step=step)
            played.rows.append(np.column_stack([result.observation, result.reward, result.terminated]))
            played.attributes.append(self._read_attributes())
            if (result.terminated | result.truncated).any():
                break
            if replaced and step == LATER:
                vars(self.env.task).update(copy.deepcopy(replaced))
        return played

    def _read_attributes(self) -> dict[str, Any]:
        items = vars(self.env.task).items()
        return {name: copy.deepcopy(v) for name, v in items if name not in self._excluded and _is_numbers(v)}

    def read_others(self, reset: int) -> dict[str, Rows]:
        """Return what belongs to the worlds but one: the state of bodies, and what the task keeps."""
        others = [world for world in range(WORLDS) if world != reset]
        kept = {f"self.{name}": getattr(self.env.task, name) for name in self.env.task.per_world}
        for name, body in self.env.sim.bodies.items():
            for quantity in ("base_position", "base_orientation", "joint_positions", "joint_velocities"):
                kept[f"{quantity} of {name!r}"] = getattr(body, quantity)
        return {name: np.array(values)[others] for name, values in kept.items()}


def _is_numbers(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf" and value.size <= MOST_NUMBERS
    return isinstance(value, NUMBERS)
