"""Compares a recorded episode with a rollout of its actions, bit for bit."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import Observations, split
from rlctl.replaying.recorder import Rollout
from rlctl.run.episode import RecordedEpisode


@dataclasses.dataclass(frozen=True)
class Difference:
    """Where a rollout begins to differ from the recorded episode."""

    step: int  # the first step that differs; 0 is the reset
    what: str
    recorded: str
    now: str
    size: float | None  # absolute difference there; None if it is not a finite number
    steps: int  # how many steps differ; 0 if only the end differs
    length: int  # steps of the recorded episode

    def __str__(self) -> str:
        by = "" if self.size is None else f" (off by {self.size:.3g})"
        many = f"; {self.steps} of {self.length + 1} steps differ" if self.steps else ""
        return f"step {self.step} of {self.length}: {self.what} is {self.now}, recorded {self.recorded}{by}{many}"


@dataclasses.dataclass(frozen=True)
class _Column:
    """Recorded and new values: a row per step from `first` on, a name per element of a row."""

    names: list[str]
    first: int
    recorded: NDArray[Any]
    now: NDArray[Any]

    def differing(self) -> list[int]:
        """Return the steps whose bits differ."""
        rows = min(len(self.recorded), len(self.now))
        before, after = self.recorded[:rows], self.now[:rows]
        if before.dtype != after.dtype or before.shape != after.shape:
            return list(range(self.first, self.first + rows))
        unequal: NDArray[np.bool_] = (_bits(before) != _bits(after)).any(axis=1)
        return (np.flatnonzero(unequal) + self.first).tolist()

    def describe(self, step: int) -> tuple[str, str, str, float | None]:
        """Return the first element that differs at a step: its name, recorded and new value, and by how much."""
        before, after = self.recorded[step - self.first], self.now[step - self.first]
        name = self.names[0].partition("[")[0]
        if before.dtype != after.dtype:
            return f"type of {name}", str(before.dtype), str(after.dtype), None
        if before.shape != after.shape:
            return f"size of {name}", str(before.size), str(after.size), None
        element = int(np.flatnonzero((_bits(before[:, None]) != _bits(after[:, None])).any(axis=1))[0])
        recorded, now = before[element].item(), after[element].item()
        size = abs(float(now) - float(recorded))
        return self.names[element], repr(recorded), repr(now), size if np.isfinite(size) else None


def _bits(values: NDArray[Any]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(values).reshape(len(values), -1).view(np.uint8)


def find_difference(recorded: RecordedEpisode, rollout: Rollout) -> Difference | None:
    """Compare observations, rewards, reward terms and the end; return None if all bits are equal."""
    length, columns = len(recorded.rewards), _columns(recorded, rollout)
    differing = [column.differing() for column in columns]
    steps = set().union(*differing)
    if not steps:
        return _different_end(recorded, rollout, length)
    first = min(steps)
    # If several columns differ in this step, report the first: a different observation explains a different reward.
    column = next(column for column, column_steps in zip(columns, differing, strict=True) if first in column_steps)
    return Difference(first, *column.describe(first), len(steps), length)


def _columns(recorded: RecordedEpisode, rollout: Rollout) -> list[_Column]:
    before, after = _parts(recorded.observations), _parts(rollout.episode.observations)
    columns = [
        _Column(_element_names(name, max(part.shape[1], 1), rollout), 0, before.get(name, part[:, :0]), part)
        for name, part in after.items()
    ]
    info = recorded.info
    columns.append(_Column(["reward"], 1, recorded.rewards[:, None], rollout.episode.rewards[:, None]))
    if info.term_names == rollout.episode.info.term_names and info.term_names:
        names = [f"term {name}" for name in info.term_names]
        columns.append(_Column(names, 1, recorded.terms, rollout.episode.terms))
    return columns


def _parts(observations: Observations) -> dict[str, NDArray[Any]]:
    return {name: values.reshape(len(values), -1) for name, values in split(observations).items()}


def _element_names(name: str, count: int, rollout: Rollout) -> list[str]:
    sizes = rollout.env.observation_sizes
    if not name and sum(sizes.values()) == count:
        return [f"observation {part}[{index}]" for part, size in sizes.items() for index in range(size)]
    label = f"observation {name}" if name else "observation"
    return [f"{label}[{index}]" for index in range(count)]


def _different_end(recorded: RecordedEpisode, rollout: Rollout, length: int) -> Difference | None:
    before, after = recorded.info, rollout.episode.info
    if rollout.length != length:
        missing = abs(length - rollout.length)
        return Difference(min(length, rollout.length), "length", str(length), str(rollout.length), missing, 0, length)
    if not rollout.ended:
        return Difference(length, "end of the episode", "here", "later", None, 0, length)
    for what, recorded_value, value in (
        ("names of the reward terms", before.term_names, after.term_names),
        ("success", before.success, after.success),
    ):
        if recorded_value != value:
            return Difference(length, what, str(recorded_value), str(value), None, 0, length)
    return None
