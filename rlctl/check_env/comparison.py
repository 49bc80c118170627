"""Compares two recordings of the same episode: the first difference, by name."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.messages import Built, Trajectory

NEARLY = 1e-5
"""Up to this a first difference is a numerical residue, such as a simulation's that was not reset in full; chaos may
make it large later. Relative to the larger value or to 1; it is also what Gymnasium's checker tolerates."""


@dataclasses.dataclass(frozen=True)
class Difference:
    """Where two trajectories begin to differ."""

    step: int
    """0 is the observation of reset."""
    element: str
    """What differs most at that step: an element of the observation, the reward, a flag, or the length."""
    first: float
    second: float
    size: float
    """The largest difference at that step, relative to the larger value or to 1."""
    largest: float
    """The same over all steps that were compared."""

    @property
    def is_small(self) -> bool:
        """Whether the two differ by a numerical residue only."""
        return self.size <= NEARLY

    def text(self) -> str:
        """Return it as a message."""
        size = f" (a residue of {self.size:.0e}, later up to {self.largest:.0e})" if self.is_small else ""
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
            "relative_difference": _plain(self.size),
            "largest_relative_difference": _plain(self.largest),
        }


def _plain(value: float) -> float | str:
    return value if np.isfinite(value) else str(value)


def find_difference(built: Built, one: Trajectory, two: Trajectory) -> Difference | None:
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
        found.append(Difference(steps, "length", one.steps, two.steps, 1.0, 1.0))
    differences = [each for each in found if each is not None]
    if not differences:
        return None
    earliest = min(differences, key=lambda each: (each.step, -each.size))
    return dataclasses.replace(earliest, largest=max(each.largest for each in differences))


def _compare(
    a: NDArray[Any], b: NDArray[Any], steps: NDArray[np.int64], built: Built | None, leaf: int, name: str = ""
) -> Difference | None:
    if not a.size:
        return None
    a, b = a.reshape(len(a), -1).astype(np.float64), b.reshape(len(b), -1).astype(np.float64)
    unequal = (a != b) & ~(np.isnan(a) & np.isnan(b))
    if not unequal.any():
        return None
    row = int(unequal.any(axis=1).argmax())
    with np.errstate(invalid="ignore", over="ignore"):
        relative = np.where(unequal, np.abs(a - b), 0.0) / np.maximum(np.maximum(np.abs(a), np.abs(b)), 1.0)
    relative = np.nan_to_num(relative, nan=np.inf, posinf=np.inf)
    flat = int(np.where(unequal[row], relative[row], -1.0).argmax())
    size, largest = float(relative[row, flat]), float(relative.max())
    element = built.element(leaf, flat) if built else name
    return Difference(int(steps[row]), element, float(a[row, flat]), float(b[row, flat]), size, largest)
