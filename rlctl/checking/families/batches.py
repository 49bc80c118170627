"""RL406 to RL409: what goes wrong only when a `BatchTask` has several worlds."""

import copy
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiment import INSTANCES, experiment
from rlctl.checking.families.determinism import NEARLY
from rlctl.checking.instance import Context, EnvironmentRaised, Instance, describe
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped
from rlctl.checking.rule import NotApplicable, NotJudged, RuleFinding, Severity, list_names
from rlctl.checking.values import NUMBERS, find_batch
from rlctl.environments.places import find_line
from rlctl.errors import WorldFailed

WORLDS, COMPARED = 4, 1  # worlds, and the one whose episode is compared
STEPS = 12
EARLIER, LATER = 2, 4  # the value that an attribute has after so many steps replaces the one after so many
MOST_NUMBERS = 10_000  # in an attribute; more are a table
WIDEST = 10.0  # of the range of actions without limits

Rows = NDArray[np.float64]


@dataclasses.dataclass
class PlayedWorlds:
    """What the worlds gave: observation, reward and whether the episode terminated, of the reset and of each step."""

    rows: list[Rows]  # shape (worlds, size + 2) each
    attributes: list[dict[str, Any]]  # numbers that the task holds after each of them, by name


@experiment("batches", INSTANCES, 30, "RL406", "RL407", "RL408", "RL409")
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
            worlds = _Worlds(instance, context)
            yield from _find_influence(worlds, alone)
            yield from _find_reset_of_others(worlds)
            yield from _find_kept_values(worlds)
        except EnvironmentRaised as error:
            if isinstance(error.cause, WorldFailed):
                raise NotJudged(f"an episode failed: {error}") from None
            message = f"{error.call} with {WORLDS} worlds raises {describe(error.cause)}"
            yield RuleFinding("RL408", message, {"call": error.call, "worlds": WORLDS}, where=find_line(error.cause))
            for rule in ("RL406", "RL407", "RL409"):
                yield Skipped(rule, f"it fails with {WORLDS} worlds (RL408)")


def _choose_actions(space: Any, seed: int) -> NDArray[Any]:
    low, high = np.maximum(space.low, -WIDEST), np.minimum(space.high, WIDEST)
    return np.random.default_rng(seed).uniform(low, high, (STEPS, *space.shape)).astype(space.dtype)


def _play_alone(instance: Instance) -> Rows:
    """Return the rows of one world, shape (steps + 1, size + 2), up to the end of its episode."""
    observation, _ = instance.reset(FIRST_SEED + COMPARED)
    rows = [np.array([*observation, 0.0, False])]
    for step, action in enumerate(_choose_actions(instance.env.action_space, COMPARED), start=1):
        observation, reward, terminated, truncated, _ = instance.call("step", instance.env.step, action, step=step)
        rows.append(np.array([*observation, reward, terminated]))
        if terminated or truncated:
            break
    return np.array(rows)


class _Worlds:
    """Several worlds of the task, which are called as the environment itself is."""

    def __init__(self, instance: Instance, context: Context) -> None:
        self._instance = instance
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
        actions = np.stack([_choose_actions(self.env.task.action_space, number) for number in numbers], axis=1)
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


def _find_difference(worlds: _Worlds, one: Sequence[Rows], two: Sequence[Rows]) -> tuple[int, str, float, float] | None:
    """Return step, name and values of the first difference of two lists of rows, shape (size + 2,) each."""
    for step, (first, second) in enumerate(zip(one, two, strict=False)):
        if (unequal := (first != second) & ~(np.isnan(first) & np.isnan(second))).any():
            index = int(unequal.argmax())
            names = [name for name, size in worlds.names for _ in range(size)]
            return step, [*names, "reward", "terminated"][index], float(first[index]), float(second[index])
    return None


def describe_difference(value: float, expected: float) -> str:
    """Return a sentence's end for two values; where their digits are alike, it is about rounding."""
    if f"{value:.9g}" != f"{expected:.9g}":
        return f"is {value:.9g}, then {expected:.9g}"
    more = "less" if expected < value else "more"
    difference = f"{abs(value - expected):.1e} {more}"
    return f"is {value:.9g}, then {difference}: a @ b rounds as the number of rows says, a * b does not"


def _find_influence(worlds: _Worlds, alone: Rows) -> Iterator[ChildMessage]:
    first, again, other = (worlds.play(others=others) for others in (0, 0, 100))
    ours, repeated, changed = ([rows[COMPARED] for rows in play.rows] for play in (first, again, other))
    if _find_difference(worlds, ours, repeated) is not None:
        yield Skipped("RL406", "an episode already differs from its repetition (RL301 to RL303)")
        return
    comparisons = [(changed, "other seeds and actions in the other worlds"), (list(alone), "one world alone")]
    for rows, what in comparisons:
        if (difference := _find_difference(worlds, ours, rows)) is not None:
            step, element, value, expected = difference
            at = "at reset" if step == 0 else f"at step {step}"
            is_small = abs(value - expected) <= NEARLY * max(abs(value), abs(expected), 1.0)
            shown = describe_difference(value, expected)
            message = f"the episode of a world differs with {what}: {at} {element} {shown}"
            evidence = {"element": element, "step": step, "seed": FIRST_SEED + COMPARED, "value": value}
            yield RuleFinding(
                "RL406", message, {**evidence, "expected": expected}, Severity.WARNING if is_small else None
            )
            return


def _find_reset_of_others(worlds: _Worlds) -> Iterator[ChildMessage]:
    worlds.play()
    reset = 2
    before = worlds.read_others(reset)
    worlds.reset([reset], [FIRST_SEED + 50])
    after = worlds.read_others(reset)
    if changed := [name for name, values in before.items() if not np.array_equal(values, after[name], equal_nan=True)]:
        message = f"the reset of world {reset} of {WORLDS} changes in the others: {list_names(changed, most=4)}"
        yield RuleFinding("RL407", message, {"element": changed[0], "call": "reset"})


def _find_kept_values(worlds: _Worlds) -> Iterator[ChildMessage]:
    reference = worlds.play()
    if len(reference.rows) <= LATER + 1:
        yield Skipped("RL409", f"episodes ended within {len(reference.rows) - 1} steps")
        return
    earlier, later = reference.attributes[EARLIER], reference.attributes[LATER]
    found: dict[Severity, list[str]] = {Severity.ERROR: [], Severity.WARNING: []}
    for name in [name for name in later if name in earlier and not np.array_equal(earlier[name], later[name])]:
        replayed = worlds.play(replaced={name: earlier[name]})
        differs = any(
            not np.array_equal(*pair, equal_nan=True) for pair in zip(reference.rows, replayed.rows, strict=False)
        )
        if differs or len(reference.rows) != len(replayed.rows):
            found[Severity.ERROR].append(f"self.{name}")
        elif np.shape(later[name])[:1] != (WORLDS,):  # one with a row per world is computed in each step
            found[Severity.WARNING].append(f"self.{name}")
    for severity, names in found.items():
        if names:
            effect = "changes what later steps give" if severity is Severity.ERROR else "is the same for all worlds"
            message = f"{list_names(names)} changes from step to step, {effect}, and is not in per_world"
            yield RuleFinding("RL409", message, {"element": names[0], "call": "step"}, severity)
            return
