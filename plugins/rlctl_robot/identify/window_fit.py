"""Least squares over windows of a log: values of the robot, and the state with which each window begins.

Multiple shooting: the joints' states at the beginning of each window are unknown too, so that the noise of encoders
and of velocities that are computed from them does not bend the values. They are eliminated window by window, so a step
of Gauss and Newton costs one world per window and group of values.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from rlctl.task.mujoco.world import hide_instability
from rlctl_robot.identify.log import Array
from rlctl_robot.identify.readings import LINEAR, ReadingErrors, find_steps
from rlctl_robot.identify.unknowns import UnknownValues
from rlctl_robot.identify.window_equations import (
    WindowEquations,
    eliminate_states,
    invert_damped,
    solve_bounded,
    tie_states,
)
from rlctl_robot.identify.windows import WindowPlayer

_MOST_ITERATIONS = 60
ENOUGH = 0.3  # smallest decrease of the cost, which is minus the logarithm of a likelihood, to continue
_REUSED = 10.0  # promised decrease, relative to the smallest to continue, above which derivatives may be old
_UNSTABLE = 1e30  # cost of a simulation without finite positions
_NEAR = 0.1  # decrease of the cost per reading, below which derivatives hold for the next step too
_DAMPINGS = (0.01, 1.0, 100.0)  # factors of the last damping, tried in one batch
_STATE_DAMPINGS = (1e-3, 1.0, 1e3)  # of start states, of which each window takes the best
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-6, 1e3
_POSITION_STEP, _VELOCITY_STEP = 2e-4, 2e-3  # [rad or m], [rad/s or m/s], for derivatives


@dataclasses.dataclass(frozen=True, eq=False)
class WindowFit:
    """The values with which the simulation follows the windows of a log best."""

    vector: Array  # shape (unknowns,)
    information: Array  # of the values, the start states eliminated, without what was known before: (unknowns,) * 2
    covariance: Array  # of the values, shape (unknowns, unknowns)
    noise: Array  # standard deviation of the errors [rad or m], shape (joints,)


@dataclasses.dataclass(frozen=True, eq=False)
class _Point:
    """Values and the states at the beginning of each window, with what is simulated with them."""

    vector: Array
    positions: Array  # shape (windows, joints)
    velocities: Array
    errors: Array  # shape (windows, rows, joints)


@dataclasses.dataclass(frozen=True, eq=False)
class _Derivatives:
    """How the errors change with the values and with the start states."""

    values: Array  # shape (windows, rows, joints, unknowns)
    states: Array  # shape (windows, rows, joints, positions and velocities)


class WindowFitter:
    """Fits values to the windows of a log that begin at the rows `starts` and have `steps` control steps."""

    def __init__(
        self,
        player: WindowPlayer,
        unknowns: UnknownValues,
        positions: Array,
        velocities: Array,
        starts: Array,
        steps: int,
    ) -> None:
        """`positions` [rad or m] are the encoders', `velocities` a first guess; shape (rows, joints)."""
        self._player, self._unknowns, self._starts, self._steps = player, unknowns, starts, steps
        self._measured = np.stack([positions[start : start + steps + 1] for start in starts])
        self._readings = ReadingErrors(find_steps(positions))
        self._first = (positions[starts], velocities[starts])
        self._lowest = unknowns.column("lowest")
        self._center, self._doubt = unknowns.column("first"), unknowns.column("doubt")
        trees = player.robot.trees
        self._places = np.array([int(np.sum(trees[:joint] == trees[joint])) for joint in range(len(trees))])
        self._same_tree = trees[:, None] == trees

    def fit(self, vector: Array, report: Callable[[str], None], enough: float = ENOUGH) -> WindowFit:
        """Return the best values near a first guess, shape (unknowns,); `enough` is the least decrease to go on for."""
        point = self._play([(np.maximum(vector, self._lowest), *self._first)])[0]
        damping, is_new = _FIRST_DAMPING, True
        derivatives = self._differentiate(point)
        for iteration in range(_MOST_ITERATIONS):
            noise = self._estimate_noise(point.errors)
            equations = self._form_equations(point, derivatives, noise)
            cost = self._compute_cost(point, noise)
            dampings = np.clip(damping * np.array(_DAMPINGS), _LEAST_DAMPING, _MOST_DAMPING)
            promised, steps = self._compute_steps(point, equations, dampings)
            candidates = self._try_steps(point, equations, steps, noise)
            costs = np.array([self._compute_cost(candidate, noise) for candidate in candidates])
            best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
            decrease = cost - float(costs[best])
            if decrease > 0:
                point, damping = candidates[best], float(dampings[best])
            report(f"step {iteration + 1}: remaining error {np.sqrt(np.square(point.errors).mean()):.3g}")
            if is_new and promised < enough:
                break
            if is_new and decrease < enough:
                if damping >= _MOST_DAMPING:
                    break
                damping = min(1000.0 * damping, _MOST_DAMPING)
                continue
            is_new = promised < _REUSED * enough or decrease > _NEAR * point.errors.size
            if is_new:
                derivatives = self._differentiate(point)
        return self._finish(point, derivatives)

    def _play(self, starts: list[tuple[Array, Array, Array]]) -> list[_Point]:
        """Simulate all windows for several values and start states in one batch."""
        windows = len(self._starts)
        vectors = np.repeat(np.array([vector for vector, _, _ in starts]), windows, axis=0)
        with hide_instability():
            played = self._player.play(
                self._unknowns.values(vectors),
                np.tile(self._starts, len(starts)),
                np.concatenate([positions for _, positions, _ in starts]),
                np.concatenate([velocities for _, _, velocities in starts]),
                self._steps,
            )
        errors = played.reshape(len(starts), *self._measured.shape) - self._measured
        return [_Point(*start, error) for start, error in zip(starts, errors, strict=True)]

    def _estimate_noise(self, errors: Array) -> Array:
        return self._readings.estimate_noise(errors.reshape(-1, errors.shape[-1]))

    def _compute_cost(self, point: _Point, noise: Array) -> float:
        known = np.square((point.vector - self._center) / self._doubt).sum() / 2
        return float(self._readings.cost(point.errors, noise).sum() + known)

    def _differentiate(self, point: _Point) -> _Derivatives:
        """Compute all derivatives in one batch of worlds."""
        unknowns, joints = self._unknowns, range(len(self._places))
        steps = unknowns.column("step")
        groups = np.array([item.group for item in unknowns.items])
        starts = [(point.vector, point.positions, point.velocities)]
        for group in range(unknowns.groups):
            changed = point.vector + steps * (groups == group)
            starts.append((changed, point.positions, point.velocities))
        places = int(self._places.max()) + 1
        for place in range(places):
            starts.append((point.vector, point.positions + _POSITION_STEP * (self._places == place), point.velocities))
        for place in range(places):
            starts.append((point.vector, point.positions, point.velocities + _VELOCITY_STEP * (self._places == place)))
        played = self._play(starts)
        by_group = [one.errors - played[0].errors for one in played[1:]]
        values = [
            by_group[item.group] / step * unknowns.affected[:, number]
            for number, (item, step) in enumerate(zip(unknowns.items, steps, strict=True))
        ]
        states = [
            by_group[begin + self._places[joint]] / step * self._same_tree[joint]
            for begin, step in ((unknowns.groups, _POSITION_STEP), (unknowns.groups + places, _VELOCITY_STEP))
            for joint in joints
        ]
        return _Derivatives(np.stack(values, axis=-1), np.stack(states, axis=-1))

    def _form_equations(self, point: _Point, derivatives: _Derivatives, noise: Array) -> WindowEquations:
        """Return the normal equations at a point, with derivatives that were computed near it."""
        slopes, curvatures = self._readings.derive(point.errors, noise)
        weights = np.sqrt(curvatures)
        windows = len(self._starts)
        errors = (slopes / weights).reshape(windows, -1)
        of_values, of_states = (
            (part * weights[..., None]).reshape(windows, errors.shape[1], -1)
            for part in (derivatives.values, derivatives.states)
        )
        return WindowEquations(
            values=np.swapaxes(of_values, 1, 2) @ of_values,
            states=tie_states(np.swapaxes(of_states, 1, 2) @ of_states),
            mixed=np.swapaxes(of_values, 1, 2) @ of_states,
            values_gradient=np.einsum("wip,wi->wp", of_values, errors),
            states_gradient=np.einsum("wip,wi->wp", of_states, errors),
        )

    def _compute_steps(self, point: _Point, equations: WindowEquations, dampings: Array) -> tuple[float, list[Array]]:
        """Return by how much the cost would decrease if the errors were linear, and a step of the values per damping.

        The steps are those of Levenberg and Marquardt within the values' bounds.
        """
        matrices, gradients = eliminate_states(equations)
        known = 1.0 / np.square(self._doubt)
        matrix = matrices.sum(axis=0) + np.diag(known)
        gradient = gradients.sum(axis=0) + known * (point.vector - self._center)
        lowest = self._lowest - point.vector
        newton, *steps = (
            solve_bounded(matrix + damping * np.diag(np.diag(matrix)), gradient, lowest) for damping in (0.0, *dampings)
        )
        return -float(gradient @ newton + newton @ matrix @ newton / 2), steps

    def _try_steps(self, point: _Point, equations: WindowEquations, steps: list[Array], noise: Array) -> list[_Point]:
        """Return a point for each step of the values, with the best start state of each window."""
        inverses = [invert_damped(equations.states, damping) for damping in _STATE_DAMPINGS]
        starts = []
        for change in steps:
            vector = np.maximum(point.vector + change, self._lowest)
            pull = equations.states_gradient + np.einsum("wps,p->ws", equations.mixed, change)
            moves = [-np.einsum("wst,wt->ws", inverse, pull) for inverse in inverses]
            starts += [(vector, *states) for states in self._propose_states(point, moves, noise)]
        points = self._play(starts)
        count = len(points) // len(steps)
        return [self._mix(points[begin : begin + count], noise) for begin in range(0, len(points), count)]

    def _propose_states(self, point: _Point, moves: list[Array], noise: Array) -> list[tuple[Array, Array]]:
        """Return start states to compare: after each of the moves, shape (windows, states), and with a joint reset."""
        joints = len(self._places)
        proposed = [(point.positions + move[:, :joints], point.velocities + move[:, joints:]) for move in moves]
        # A joint that rests has another minimum where it begins with a speed and stops: no small step leads out of it.
        costs = self._readings.cost(point.errors, noise).sum(axis=1)
        is_worst = costs >= np.where(self._same_tree, costs[:, None], -np.inf).max(axis=-1)
        first = [np.where(is_worst, *pair) for pair in zip(self._first, proposed[0], strict=True)]
        return [*proposed, (first[0], first[1]), (first[0], np.where(is_worst, 0.0, first[1]))]

    def _mix(self, points: list[_Point], noise: Array) -> _Point:
        """Return points of the same values as one, each window and tree with the start state of the least cost."""
        costs = np.array([self._readings.cost(point.errors, noise).sum(axis=1) for point in points])
        costs = np.where(np.isfinite(costs), costs, _UNSTABLE) @ self._same_tree  # of each joint's tree
        best, windows, joints = costs.argmin(axis=0), np.arange(len(self._starts))[:, None], np.arange(costs.shape[-1])
        positions, velocities = (
            np.stack([getattr(point, name) for point in points])[best, windows, joints]
            for name in ("positions", "velocities")
        )
        errors = np.stack([np.swapaxes(point.errors, 1, 2) for point in points])[best, windows, joints]
        return _Point(points[0].vector, positions, velocities, np.swapaxes(errors, 1, 2))

    def _finish(self, point: _Point, derivatives: _Derivatives) -> WindowFit:
        noise = self._estimate_noise(point.errors)
        equations = self._form_equations(point, derivatives, noise)
        matrices, gradients = eliminate_states(equations)
        information = matrices.sum(axis=0)
        total = information + np.diag(1.0 / np.square(self._doubt))
        inverse = np.linalg.inv(total)
        # Errors of a window are alike, such as those of the model: values differ more than their noise tells where one
        # window is left out. The jackknife counts this in full where few windows tell a value (Efron and Stein, 1981).
        moved = np.linalg.solve(total - matrices, gradients[..., None])[..., 0]
        moved = moved - moved.mean(axis=0)
        measured = (1.0 - 1.0 / len(moved)) * np.square(moved).sum(axis=0)
        widen = np.sqrt(np.maximum(1.0, measured / np.diag(inverse)))
        # The noise is that of the best values and start states, and smaller than that of the true ones.
        fitted = len(point.vector) + point.positions.size + point.velocities.size
        freedom = point.errors.size / max(point.errors.size - fitted, 1)
        spread = self._readings.spread(noise)
        clipped = np.clip(point.errors, -LINEAR * spread, LINEAR * spread)
        remaining = np.sqrt(np.square(clipped).mean(axis=(0, 1)))
        return WindowFit(point.vector, information, freedom * inverse * np.outer(widen, widen), remaining)
