"""A worker process that follows a log: costs of many values, and least squares from one start."""

from __future__ import annotations

import json
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from rlctl.deploy.identify.follow import Follower, open_world
from rlctl.deploy.identify.log import Array, Log
from rlctl.deploy.identify.parameters import Parameter, Unknowns
from rlctl.deploy.identify.search import encode
from rlctl.env_spec import EnvSpec
from rlctl.errors import RlctlError

_STEP = 0.004
"""Of a position in [0, 1], for derivatives: above what contacts and solvers make uneven."""
_TOLERANCE = 1e-5


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
