"""Comparing two lives of the same episode: the first difference, named."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.evidence import Built, Trajectory

NEARLY = 1e-6
"""Difference up to which two trajectories are nearly equal, relative to the larger value or to 1."""


@dataclasses.dataclass(frozen=True)
class Difference:
    """Where two trajectories part."""

    step: int
    """0 is the observation of reset."""
    element: str
    """The element of the observation, `reward`, `terminated`, `truncated`, or `length`."""
    first: float
    second: float
    largest: float
    """The largest difference in everything that was compared, relative to the larger value or to 1."""

    @property
    def is_small(self) -> bool:
        """Whether the two are nearly equal to the end."""
        return self.largest <= NEARLY

    def text(self) -> str:
        """Say it in words."""
        size = f", up to {self.largest:.1e} relative later" if self.is_small else ""
        at = "at reset" if self.step == 0 else f"at step {self.step}"
        return f"first difference {at}: {self.element} is {self.first:.9g}, then {self.second:.9g}{size}"

    def evidence(self, trajectory: Trajectory) -> dict[str, Any]:
        """Return it with the trajectory's seed, as a finding's evidence."""
        return {
            "seed": trajectory.seed,
            "step": self.step,
            "element": self.element,
            "value": _plain(self.second),
            "expected": _plain(self.first),
            "largest_relative_difference": _plain(self.largest),
        }


def _plain(value: float) -> float | str:
    return value if np.isfinite(value) else str(value)


def first_difference(built: Built, one: Trajectory, two: Trajectory) -> Difference | None:
    """Compare two trajectories bit for bit as far as both go; NaN equals NaN."""
    found = []
    for index, _ in enumerate(built.leaves):
        a, b = one.observations.get(index), two.observations.get(index)
        if a is None or b is None:
            continue
        rows = min(len(a.values), len(b.values))
        found.append(_compare(a.values[:rows], b.values[:rows], a.steps[:rows], built, index))
    steps = min(one.steps, two.steps)
    after = np.arange(1, steps + 1)
    for name in ("rewards", "terminated", "truncated"):
        a_, b_ = getattr(one, name)[:steps], getattr(two, name)[:steps]
        found.append(_compare(a_, b_, after, None, 0, "reward" if name == "rewards" else name))
    if one.has_ended and two.has_ended and one.steps != two.steps:
        found.append(Difference(steps, "length", one.steps, two.steps, 1.0))
    differences = [each for each in found if each is not None]
    if not differences:
        return None
    earliest = min(differences, key=lambda each: each.step)
    return dataclasses.replace(earliest, largest=max(each.largest for each in differences))


def _compare(
    a: NDArray[Any], b: NDArray[Any], steps: NDArray[np.int64], built: Built | None, leaf: int, name: str = ""
) -> Difference | None:
    a, b = a.reshape(len(a), -1).astype(np.float64), b.reshape(len(b), -1).astype(np.float64)
    unequal = (a != b) & ~(np.isnan(a) & np.isnan(b))
    if not unequal.any():
        return None
    row, flat = np.argwhere(unequal)[0].tolist()
    with np.errstate(invalid="ignore", over="ignore"):
        relative = np.abs(a - b)[unequal] / np.maximum(np.maximum(np.abs(a), np.abs(b))[unequal], 1.0)
    largest = float(np.nan_to_num(relative, nan=np.inf, posinf=np.inf).max())
    element = built.element(leaf, flat) if built else name
    return Difference(int(steps[row]), element, float(a[row, flat]), float(b[row, flat]), largest)
