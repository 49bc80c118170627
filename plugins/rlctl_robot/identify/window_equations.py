"""Normal equations of the windows of a log, of which each has a start state of its own."""

import dataclasses

import numpy as np

from rlctl_robot.identify.log import Array

_TIE = 1e-6  # weight with which a start state stays where it is, relative to what its window says


@dataclasses.dataclass(frozen=True, eq=False)
class WindowEquations:
    """Normal equations of each window: of the values, of its start state, and between them."""

    values: Array  # (windows, unknowns, unknowns)
    states: Array  # (windows, states, states)
    mixed: Array  # (windows, unknowns, states)
    values_gradient: Array  # (windows, unknowns)
    states_gradient: Array  # (windows, states)


def eliminate_states(equations: WindowEquations) -> tuple[Array, Array]:
    """Return each window's matrix and gradient of the values alone.

    Their shapes are (windows, unknowns, unknowns) and (windows, unknowns).
    """
    influence = equations.mixed @ invert_damped(equations.states, 0.0)
    matrices: Array = equations.values - influence @ np.swapaxes(equations.mixed, 1, 2)
    gradients: Array = equations.values_gradient - np.einsum("wps,ws->wp", influence, equations.states_gradient)
    return matrices, gradients


def invert_damped(matrices: Array, damping: float) -> Array:
    """Return the inverses of matrices of start states, damped relative to their diagonals."""
    return np.asarray(np.linalg.inv(matrices * (1.0 + damping * np.eye(matrices.shape[-1]))), np.float64)


def tie_states(matrices: Array) -> Array:
    """Return matrices of start states that hold a state of which the window tells nothing where it is."""
    size = matrices.shape[-1]
    sizes = np.trace(matrices, axis1=1, axis2=2)[:, None, None] / size
    tied: Array = matrices + _TIE * np.maximum(sizes, 1e-12) * np.eye(size)
    return tied


def solve_bounded(matrix: Array, gradient: Array, lowest: Array) -> Array:
    """Return the step that minimises a quadratic; components that would fall below `lowest` end there."""
    change = np.linalg.solve(matrix, -gradient)
    held = change < lowest
    if not held.any() or held.all():
        return np.maximum(change, lowest)
    free = ~held
    change[held] = lowest[held]
    pull = gradient[free] + matrix[np.ix_(free, held)] @ change[held]
    change[free] = np.linalg.solve(matrix[np.ix_(free, free)], -pull)
    return np.maximum(change, lowest)
