"""`rlctl serve --self-test`: does a policy score the same in simulation with and without its server?"""

import asyncio
import dataclasses
import os
import threading
from concurrent.futures import Future
from typing import Any

import numpy as np

from rlctl import output
from rlctl.errors import AnswerIsNo
from rlctl.evaluation import report
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import Evaluation, run_evaluation
from rlctl.play.workers import available_cores
from rlctl_robot.serve.serve import make_loop, serve_until
from rlctl_robot.serve.server import PolicyServer

_LATE_SHARE = 0.001  # so many late answers are the computer's: 99.9 % are in time


@dataclasses.dataclass(frozen=True)
class SelfTest:
    """The scores of a policy with and without its server, and how long answers took."""

    direct: Evaluation
    served: Evaluation
    control_dt: float | None
    round_trip_p50_s: float
    round_trip_p99_s: float
    requests: int
    misses: int  # answers that took longer than `control_dt`
    not_running: int  # answers of a server that held or stopped
    load: float  # load average of the last minute, which includes the test

    def list_problems(self) -> list[str]:
        """Return why the self-test fails; empty if it passes."""
        problems = []
        rate, interval = self.served.success_rate, self.direct.success_interval
        if rate is not None and interval is not None and not interval[0] <= rate <= interval[1]:
            problems.append(
                f"success rate {rate:.1%} through the server, {self.direct.success_rate:.1%} without "
                f"(95 % interval {interval[0]:.1%} to {interval[1]:.1%})"
            )
        if self.not_running:
            problems.append(f"{self.not_running:,} answers came while the server was holding or stopped")
        if self.control_dt is not None and self.round_trip_p99_s >= self.control_dt:
            problems.append(f"p99 {self.round_trip_p99_s * 1e3:.3g} ms is not below control_dt, {self.control_dt:g} s")
        if self.misses > _LATE_SHARE * self.requests:
            busy = self.load > available_cores()
            hint = f"; other programs were running (load {self.load:.1f}): repeat without them" if busy else ""
            problems.append(f"{self.misses:,} of {self.requests:,} answers took longer than control_dt{hint}")
        return problems

    def check(self) -> None:
        """Raise `AnswerIsNo`, naming every problem."""
        if problems := self.list_problems():
            raise AnswerIsNo("self-test failed: " + "; ".join(problems))


def run_self_test(server: PolicyServer, request: EvalRequest) -> SelfTest:
    """Evaluate a policy without a server, then through `server`, which listens on a free port during the test.

    Both act within the request's limits, on the same episodes.
    """
    direct = run_evaluation(request)
    address: Future[str] = Future()
    end = asyncio.Event()
    loop = make_loop()

    def serve() -> None:
        try:
            loop.run_until_complete(serve_until(server, address.set_result, end))
        except BaseException as error:
            address.set_exception(error)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        served = run_evaluation(
            EvalRequest(
                direct.spec.task,
                baseline=f"ws://{address.result()}",
                spec=direct.spec,
                episodes=request.episodes,
                seed=request.seed,
                n_envs=1,  # like one robot; more simulations would slow down the server
                env_timeout_s=request.env_timeout_s,
            )
        )
    finally:
        loop.call_soon_threadsafe(end.set)
        thread.join(5.0)
    reports = [episode.result.report for episode in served.played]
    times = np.concatenate([np.asarray(answers["round_trips_s"]) for answers in reports])
    p50, p99 = np.quantile(times, (0.5, 0.99)).tolist()
    return SelfTest(
        direct,
        served,
        server.posting.safety.control_dt,
        p50,
        p99,
        len(times),
        sum(answers["misses"] for answers in reports),
        sum(answers["not_running"] for answers in reports),
        os.getloadavg()[0],
    )


def show(result: SelfTest, json: str | None) -> None:
    """Print a self-test, or JSON alone for `-`."""
    if output.present(as_json(result), json):
        return
    out, direct, served = output.out(), result.direct, result.served
    episodes = output.format_count(len(served.played), "episode")
    out.print(f"{direct.spec.task}: {direct.name}, {episodes}, through a server")
    if served.success_rate is not None:
        out.print(f"success rate {served.success_rate:.1%}, {direct.success_rate:.1%} without the server")
    out.print(f"return {served.returns.mean:.4g}, {direct.returns.mean:.4g} without the server")
    late = "" if result.control_dt is None else f"; {result.misses} later than control_dt, {result.control_dt:.4g} s"
    out.print(
        f"{result.requests:,} answers: p50 {result.round_trip_p50_s * 1e3:.3g} ms, "
        f"p99 {result.round_trip_p99_s * 1e3:.3g} ms{late}"
    )


def as_json(result: SelfTest) -> dict[str, Any]:
    """Return a self-test as plain data, with both evaluations as `rlctl eval` writes them."""
    evaluations = {name: report.as_json(getattr(result, name)) for name in ("direct", "served")}
    return {**vars(result), **evaluations, "problems": result.list_problems()}
