"""The search, in worker processes, for the values that make the simulation follow a log: trials, least squares."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import queue
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from rlctl import errors
from rlctl.deploy.identify.follow import Follower, open_world
from rlctl.deploy.identify.log import Array, Log
from rlctl.deploy.identify.parameters import Parameter, Unknowns
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RlctlError, TaskError
from rlctl.processes.child_process import ChildProcess

_TRIALS = 12  # per unknown, and as many again
_STARTS = 3
_EVALUATIONS, _LAST_EVALUATIONS = 12, 25
_STEP = 0.004
"""Of a position in [0, 1], for derivatives: above what contacts and solvers make uneven."""
_TOLERANCE = 1e-5
_LONGEST_DELAY = 50  # steps that the search may go to from the longest that is tried first


@dataclasses.dataclass(frozen=True)
class Fit:
    """Where a search ended: positions of the values in their ranges."""

    at: Array
    delay: int
    cost: float
    """Mean of the squared weighted errors."""
    information: Array
    """J'J of the weighted errors, shape (unknowns, unknowns)."""
    errors: Array
    """Root mean square per measured position, then velocity, in their units."""
    rows_per_window: float


def encode(message: Any) -> bytes:
    """Return a message between the search and its workers: JSON, in which arrays are lists."""
    return json.dumps(message, default=np.ndarray.tolist).encode()


class SearchWorkers:
    """Processes that follow a log. Answers come in the order of the questions; errors of the task are raised here."""

    def __init__(self, spec: EnvSpec, log: Log, unknowns: Unknowns, count: int) -> None:
        first = encode({"log": dataclasses.asdict(log), "unknowns": dataclasses.asdict(unknowns)})
        self.count = count
        self._children = contextlib.ExitStack()
        self._free: queue.SimpleQueue[Connection] = queue.SimpleQueue()
        self._threads = ThreadPoolExecutor(count)
        try:
            for _ in range(count):
                spec_of_child = {"spec": dataclasses.asdict(spec)}
                child = ChildProcess("rlctl.deploy.identify.search:main", spec_of_child, stdout=2, stderr=2)
                self._children.callback(child.close)
                child.connection.send_bytes(first)
                self._free.put(child.connection)
        except BaseException:
            self._children.close()
            raise

    def ask(self, questions: Sequence[dict[str, Any]]) -> list[Any]:
        """Return the answers to questions, each given to the next worker that is free."""
        return list(self._threads.map(self._ask_one, questions))

    def _ask_one(self, question: dict[str, Any]) -> Any:
        connection = self._free.get()
        try:
            connection.send_bytes(encode(question))
            answer = json.loads(connection.recv_bytes())
        except (EOFError, OSError):
            raise TaskError("a worker process ended while it followed the log; see what it printed") from None
        finally:
            self._free.put(connection)
        if isinstance(answer, dict) and "error" in answer:
            raise getattr(errors, answer["error"], TaskError)(answer["message"])
        return answer

    def __enter__(self) -> SearchWorkers:
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)
        self._children.close()


def search(
    workers: SearchWorkers, unknowns: Unknowns, weights: Array, seed: int, report: Callable[[str], None]
) -> dict[int, Fit]:
    """Return the best fit per delay that was followed up; the best of all has the lowest cost.

    Trials all over the ranges choose where least squares start; then the delays beside the best one are tried, and the
    errors are weighted anew, each measured signal by how well it can be followed.
    """
    fits: dict[int, Fit] = {}

    def follow_up(questions: list[dict[str, Any]]) -> None:
        for answer in workers.ask(questions):
            arrays = {key: np.array(answer[key], np.float64) for key in ("at", "information", "errors")}
            fit = Fit(**{**answer, **arrays})
            if fit.delay not in fits or fit.cost < fits[fit.delay].cost:
                fits[fit.delay] = fit

    trials = _make_trials(unknowns, seed)
    report(f"{len(trials)} trials")
    parts = [trials[index :: workers.count * 4] for index in range(workers.count * 4)]
    costs = workers.ask([{"trials": part, "weights": weights} for part in parts if part])
    ranked = sorted(
        (
            (cost, trial)
            for part, found in zip(parts, costs, strict=False)
            for cost, trial in zip(_take_costs(found), part, strict=True)
        ),
        key=lambda pair: pair[0],
    )
    starts = _choose_starts(trials[0], [trial for _, trial in ranked])
    report(f"least squares from {len(starts)} starts")
    follow_up([_ask_fit(trial["at"], trial["delay"], weights, _EVALUATIONS) for trial in starts])
    best = _best(fits)
    while beside := [d for d in (best.delay - 1, best.delay + 1) if 0 <= d <= _LONGEST_DELAY and d not in fits]:
        follow_up([_ask_fit(best.at, delay, weights, _EVALUATIONS) for delay in beside])
        if _best(fits).delay == best.delay:
            break
        best = _best(fits)
    best = _best(fits)
    report("intervals")
    final = 1.0 / np.maximum(best.errors, 1e-4 / weights)
    near = [d for d in (best.delay - 1, best.delay, best.delay + 1) if d in fits]
    fits = {}
    follow_up(
        [_ask_fit(best.at, delay, final, _LAST_EVALUATIONS if delay == best.delay else _EVALUATIONS) for delay in near]
    )
    return fits


def _take_costs(found: Any) -> list[float]:
    # A simulation that diverged costs more than any other.
    return [cost if np.isfinite(cost) else np.inf for cost in found]


def _best(fits: dict[int, Fit]) -> Fit:
    return min(fits.values(), key=lambda fit: fit.cost)


def _ask_fit(at: Array | list[float], delay: int, weights: Array, evaluations: int) -> dict[str, Any]:
    return {"at": at, "delay": delay, "weights": weights, "evaluations": evaluations}


def _make_trials(unknowns: Unknowns, seed: int) -> list[dict[str, Any]]:
    """Return the built world with every delay, then points all over the ranges, with every delay in turn."""
    from scipy.stats import qmc

    size = len(unknowns.parameters)
    delays = range(unknowns.longest_delay + 1)
    built = [{"at": [each.first for each in unknowns.parameters], "delay": delay} for delay in delays]
    if size == 0:
        return built
    count = max(len(delays), _TRIALS * (size + 1))
    points = qmc.Halton(size, seed=seed).random(count).tolist()
    return built + [{"at": point, "delay": delays[index % len(delays)]} for index, point in enumerate(points)]


def _choose_starts(built: dict[str, Any], ranked: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the best trial of each of the best delays, then the next best ones, and the built world."""
    firsts = list({trial["delay"]: trial for trial in reversed(ranked)}.values())
    firsts = [trial for trial in ranked if trial in firsts][:_STARTS]
    others = [trial for trial in ranked if trial not in firsts]
    starts = [*firsts, *others[: max(0, _STARTS - len(firsts))]]
    return starts if built in starts else [*starts, built]


def main(connection: Connection, spec: dict[str, Any]) -> None:
    """Build the world, then answer messages until the connection closes."""
    try:
        first = json.loads(connection.recv_bytes())
        parameters = tuple(Parameter(**each) for each in first["unknowns"].pop("parameters"))
        log = Log(tuple(first["log"].pop("joints")), **{key: np.array(each) for key, each in first["log"].items()})
        follower = Follower(open_world(EnvSpec(**spec)), log, Unknowns(parameters, **first["unknowns"]))
        while True:
            message = json.loads(connection.recv_bytes())
            connection.send_bytes(encode(_answer(follower, message)))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


def _answer(follower: Follower, message: dict[str, Any]) -> Any:
    try:
        weights = np.array(message["weights"])
        if "trials" in message:
            return [_compute_cost(follower, np.array(each["at"]), each["delay"], weights) for each in message["trials"]]
        return _fit(follower, np.array(message["at"]), message["delay"], weights, message["evaluations"])
    except RlctlError as error:
        return {"error": type(error).__name__, "message": str(error)}


def _compute_cost(follower: Follower, at: Array, delay: int, weights: Array) -> float:
    return float(np.square(follower.compare(at, delay) * weights).mean())


def _fit(follower: Follower, at: Array, delay: int, weights: Array, evaluations: int) -> dict[str, Any]:
    """Return the best positions near `at`, with what intervals are made from."""

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

        found = least_squares(
            residuals,
            np.clip(at, 1e-6, 1 - 1e-6),
            jacobian,
            bounds=(0.0, 1.0),
            max_nfev=evaluations,
            xtol=_TOLERANCE,
            ftol=_TOLERANCE,
        )
        at, errors, derivatives = found.x, found.fun, np.asarray(found.jac)
    else:  # only the delay is looked for
        errors, derivatives = residuals(at), np.zeros((0, 0))
    by_row = errors.reshape(-1, len(weights))
    return {
        "at": at,
        "delay": delay,
        "cost": float(np.square(errors).mean()),
        "information": derivatives.T @ derivatives,
        "errors": np.sqrt(np.square(by_row / weights).mean(axis=0)),
        "rows_per_window": len(by_row) / len(follower.starts),
    }
