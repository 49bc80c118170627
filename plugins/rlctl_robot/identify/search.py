"""Searches in worker processes for the values with which the simulation follows a log: trials, then least squares."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError
from rlctl.play.messages import describe_failure, make_error
from rlctl.processes.messages import trust_package
from rlctl.processes.pool import ProcessPool, WorkerException, WorkerFault, answer_messages
from rlctl_robot.identify.follow import Follower, Unknowns, open_world
from rlctl_robot.identify.log import Array, Log

_TRIALS = 12  # per unknown, and for one unknown more
_STARTS = 3
_EVALUATIONS, _LAST_EVALUATIONS = 12, 25
_STEP = 0.004  # step of a position in [0, 1] for derivatives: larger than the irregularities of contacts and solvers
_TOLERANCE = 1e-5
_MAX_DELAY = 50  # [control steps], beyond which the search does not go

trust_package("rlctl_robot")


@dataclasses.dataclass(frozen=True)
class Fit:
    """The result of least squares: positions of the values in their ranges, in [0, 1]."""

    at: Array
    delay: int
    cost: float  # mean of the squared weighted errors
    information: Array  # J'J of the weighted errors, shape (unknowns, unknowns)
    errors: Array  # root mean square per measured position, then velocity, in their units
    rows_per_window: float


@dataclasses.dataclass(frozen=True)
class Follow:
    """The first request to a worker: load the log and build the world."""

    spec: EnvSpec
    log: Log
    unknowns: Unknowns


@dataclasses.dataclass(frozen=True)
class SearchPoint:
    """A point of the search: positions of the values in their ranges, and a delay [steps]."""

    at: list[float]
    delay: int


@dataclasses.dataclass(frozen=True)
class FindFit:
    """Asks a worker for the best fit near a point, or without `evaluations` for the cost of the point."""

    start: SearchPoint
    weights: Array
    evaluations: int = 0


Ask = Callable[[Sequence[Follow | FindFit]], list[Any]]
"""Sends each question to the next free worker; returns the answers in the order of the questions."""


@contextlib.contextmanager
def start_search_workers(spec: EnvSpec, log: Log, unknowns: Unknowns, count: int) -> Iterator[Ask]:
    """Start processes that simulate a log; yield a function that asks them, and raises the task's errors."""
    pool = ProcessPool("rlctl_robot.identify.search:main", [{}] * count)

    def ask(questions: Sequence[Follow | FindFit]) -> list[Any]:
        try:
            answers = pool.ask_each(questions, "following the log")
        except WorkerFault as fault:
            raise TaskError(f"task {spec.task!r}: {fault}; its output is above") from None
        if isinstance(answers[-1], WorkerException):
            raise make_error(answers[-1], spec.task)
        return answers

    try:
        ask([Follow(spec, log, unknowns)] * count)
        yield ask
    finally:
        pool.close(grace_s=0.0)


def search(ask: Ask, unknowns: Unknowns, weights: Array, seed: int, report: Callable[[str], None]) -> dict[int, Fit]:
    """Return the best fit for the best delay and its neighbours; the lowest cost is the best.

    Trials all over the ranges choose the starts of least squares. Then delays next to the best one are tried, and the
    errors are weighted again: each measured signal by its remaining error.
    """
    fits: dict[int, Fit] = {}

    def fit_all(questions: list[FindFit]) -> None:
        for fit in ask(questions):
            if fit.delay not in fits or fit.cost < fits[fit.delay].cost:
                fits[fit.delay] = fit

    trials = _make_trials(unknowns, seed)
    report(f"{len(trials)} trials")
    costs = ask([FindFit(trial, weights) for trial in trials])
    starts = _choose_starts(trials[0], [trials[index] for index in np.argsort(costs, kind="stable")])
    report(f"least squares from {len(starts)} starts")
    fit_all([FindFit(start, weights, _EVALUATIONS) for start in starts])
    tried = -1  # the delay whose neighbours were tried last
    while (best := min(fits.values(), key=lambda fit: fit.cost)).delay != tried:
        tried = best.delay
        delays = (delay for delay in (tried - 1, tried + 1) if 0 <= delay <= _MAX_DELAY and delay not in fits)
        if neighbours := [FindFit(SearchPoint(best.at.tolist(), delay), weights, _EVALUATIONS) for delay in delays]:
            fit_all(neighbours)
    report("intervals")
    weights = 1.0 / np.maximum(best.errors, 1e-4 / weights)
    near = [delay for delay in (best.delay - 1, best.delay, best.delay + 1) if delay in fits]
    fits = {}
    evaluations = {delay: _LAST_EVALUATIONS if delay == best.delay else _EVALUATIONS for delay in near}
    fit_all([FindFit(SearchPoint(best.at.tolist(), delay), weights, evaluations[delay]) for delay in near])
    return fits


def _make_trials(unknowns: Unknowns, seed: int) -> list[SearchPoint]:
    """Return the nominal values with every delay, then points all over the ranges, with the delays in turn."""
    from scipy.stats import qmc

    size = len(unknowns.parameters)
    delays = range(unknowns.longest_delay + 1)
    built = [SearchPoint([parameter.first for parameter in unknowns.parameters], delay) for delay in delays]
    if size == 0:
        return built
    points = qmc.Halton(size, seed=seed).random(max(len(delays), _TRIALS * (size + 1))).tolist()
    return built + [SearchPoint(point, delays[index % len(delays)]) for index, point in enumerate(points)]


def _choose_starts(built: SearchPoint, ranked: list[SearchPoint]) -> list[SearchPoint]:
    """Return the best trial of each of the best delays, then the next best trials, and the nominal one."""
    firsts = list({trial.delay: trial for trial in reversed(ranked)}.values())
    firsts = [trial for trial in ranked if trial in firsts][:_STARTS]
    others = [trial for trial in ranked if trial not in firsts]
    starts = [*firsts, *others[: max(0, _STARTS - len(firsts))]]
    return starts if built in starts else [*starts, built]


def main(connection: Connection) -> None:
    """Answer questions until the connection closes; the first one is `Follow`."""
    follower: Follower

    def answer(question: Follow | FindFit) -> float | Fit | None:
        nonlocal follower
        if isinstance(question, Follow):
            follower = Follower(open_world(question.spec), question.log, question.unknowns)
            return None
        return _find_fit(follower, question) if question.evaluations else _compute_cost(follower, question)

    answer_messages(connection, answer, describe_failure)


def _compute_cost(follower: Follower, question: FindFit) -> float:
    errors = follower.compare(np.array(question.start.at), question.start.delay)
    cost = float(np.square(errors * question.weights).mean())
    return cost if np.isfinite(cost) else np.inf  # a simulation diverged


def _find_fit(follower: Follower, question: FindFit) -> Fit:
    weights, delay, at = question.weights, question.start.delay, np.array(question.start.at)

    def residuals(positions: Array) -> Array:
        return (follower.compare(np.asarray(positions), delay) * weights).ravel()

    def jacobian(positions: Array) -> Array:
        # Central, and one-sided at the ends of a range.
        columns = []
        for index in range(len(positions)):
            low, high = positions.copy(), positions.copy()
            low[index], high[index] = max(positions[index] - _STEP, 0.0), min(positions[index] + _STEP, 1.0)
            columns.append((residuals(high) - residuals(low)) / (high[index] - low[index]))
        return np.stack(columns, axis=1)

    errors: Array
    derivatives: Array
    if len(at):
        from scipy.optimize import least_squares

        solution = least_squares(
            residuals,
            np.clip(at, 1e-6, 1 - 1e-6),
            jacobian,
            bounds=(0.0, 1.0),
            max_nfev=question.evaluations,
            xtol=_TOLERANCE,
            ftol=_TOLERANCE,
        )
        at, errors, derivatives = solution.x, solution.fun, np.asarray(solution.jac)
    else:  # only the delay is unknown
        errors, derivatives = residuals(at), np.zeros((0, 0))
    by_row = errors.reshape(-1, len(weights))
    return Fit(
        at=at,
        delay=delay,
        cost=float(np.square(errors).mean()),
        information=derivatives.T @ derivatives,
        errors=np.sqrt(np.square(by_row / weights).mean(axis=0)),
        rows_per_window=len(by_row) / len(follower.starts),
    )
