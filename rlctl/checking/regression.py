"""Whether numbers are exactly a sum of some quantities in nearly all steps; rare terms, as a bonus is, are left out."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.transitions import Transitions, find_differences, find_functions, find_simple

KEPT = 0.8  # part of the steps that has to fit: the others may have a bonus
ROUNDS = 3  # of leaving out what fits worst
ROWS_PER_COLUMN = 2.5
MOST_PICKED = 2  # differences in one sum
EXACT = 2e-5  # error relative to the standard deviation of the numbers: rounding of observations to float32
RIDGE = 1e-11
REFINEMENTS, FEW_REFINEMENTS = 30, 2
CHECKED_ROWS = 500  # that were not fitted


@dataclasses.dataclass(frozen=True)
class RewardFit:
    """How well a sum of quantities gives some numbers that it was not fitted to."""

    error: float  # Exceeded in one step of five; relative to the numbers' standard deviation
    median_error: float
    picked: tuple[str, ...] = ()  # Differences that it needs

    @property
    def is_exact(self) -> bool:
        """Whether only rounding is left."""
        return self.error <= EXACT


def action_terms(steps: Transitions) -> NDArray[np.float64]:
    """Return a constant, and what a cost of acting may be made of. Shape (n, terms)."""
    actions, change = steps.actions, steps.actions - steps.earlier_actions
    sums = [np.linalg.norm(actions, axis=1), np.linalg.norm(change, axis=1), np.square(change).sum(axis=1)]
    columns = [np.ones(len(actions)), *actions.T, *np.square(actions).T, *np.abs(actions).T, *sums]
    return np.array([*columns, np.abs(change).sum(axis=1)]).T


def fit_observation(steps: Transitions, rows: NDArray[np.float64]) -> RewardFit:
    """Fit the rewards by terms of the action, and quantities of the given observations. Shape of rows: (n, elements).

    Differences, and functions of lengths, are added one by one: what explains most of what is left."""
    simple = find_simple(rows, steps.names)
    columns = np.hstack([action_terms(steps), simple.values])
    fit, inliers = _fit(columns, steps.rewards)
    picked: list[str] = []
    more = None if fit.is_exact else find_differences(rows, steps.names) + find_functions(rows, steps.names)
    while more is not None and more.names and not fit.is_exact and len(picked) < MOST_PICKED:
        best = _find_best(columns[inliers], more.values[inliers], steps.rewards[inliers])
        picked.append(more.names[best])
        columns = np.hstack([columns, more.values[:, best : best + 1]])
        fit, inliers = _fit(columns, steps.rewards)
    return dataclasses.replace(fit, picked=tuple(picked))


def fit_terms(columns: NDArray[np.float64], target: NDArray[np.float64]) -> RewardFit:
    """Fit numbers by given columns. Shapes (n, terms) and (n,)."""
    return _fit(columns, target)[0]


def _fit(columns: NDArray[np.float64], target: NDArray[np.float64]) -> tuple[RewardFit, NDArray[np.intp]]:
    scale = np.abs(columns).max(axis=0)
    columns = columns / np.where(scale > 0, scale, 1.0)
    fitted = min(len(target) * 2 // 3, int(ROWS_PER_COLUMN * columns.shape[1]) + 50)
    inliers = np.arange(fitted)
    for _ in range(ROUNDS):
        weights = _solve(columns[inliers], target[inliers, None])[:, 0]
        errors = np.abs(target[:fitted] - columns[:fitted] @ weights)
        inliers = np.argsort(errors)[: int(KEPT * fitted)]
    checked = slice(fitted, fitted + CHECKED_ROWS)
    errors = np.abs(target[checked] - columns[checked] @ weights) / max(float(target.std()), 1e-12)
    return RewardFit(float(np.quantile(errors, KEPT)), float(np.median(errors))), inliers


def _solve(
    columns: NDArray[np.float64], targets: NDArray[np.float64], refinements: int = REFINEMENTS
) -> NDArray[np.float64]:
    """Return the least squares weights of columns up to 1 in size. Shapes (n, k) and (n, m); returns (k, m).

    Normal equations with a small ridge, refined: many columns depend on each other, and `lstsq` takes ten times as
    long."""
    inverse = np.linalg.inv(columns.T @ columns + RIDGE * len(columns) * np.eye(columns.shape[1]))
    weights = np.zeros((columns.shape[1], targets.shape[1]))
    for _ in range(refinements):
        weights += inverse @ (columns.T @ (targets - columns @ weights))
    return weights


def _find_best(columns: NDArray[np.float64], candidates: NDArray[np.float64], target: NDArray[np.float64]) -> int:
    """Return which candidate explains most of what the columns leave."""
    columns = columns / np.maximum(np.abs(columns).max(axis=0), 1e-300)
    targets = np.hstack([candidates, target[:, None]])
    left = targets - columns @ _solve(columns, targets, FEW_REFINEMENTS)
    norms = np.linalg.norm(left[:, :-1], axis=0)
    is_new = norms > 1e-5 * np.linalg.norm(candidates, axis=0)
    return int(np.argmax(np.where(is_new, np.abs(left[:, -1] @ left[:, :-1]) / np.maximum(norms, 1e-300), 0.0)))
