"""Builds the environment where a training with several processes does: in a daemonic, spawned worker."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import multiprocessing
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any

from rlctl.check_env.context import Context
from rlctl.check_env.evidence import FIRST_SEED
from rlctl.check_env.failures import describe
from rlctl.check_env.legacy import result
from rlctl.check_env.messages import Message
from rlctl.check_env.results import WorkerBuild

HANG_S = 10.0
"""A call in the worker that takes longer hangs: each took less than a second or two in this process, or its time
would be over before this is tried [s]."""
LONGEST_S = 30.0


def worker_build(context: Context) -> Iterator[Message]:
    """Build, reset, step and close in a worker as Stable-Baselines3's SubprocVecEnv starts them."""
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe(duplex=False)
    worker = spawn.Process(target=_work, args=(theirs, json.dumps(dataclasses.asdict(context.spec))), daemon=True)
    worker.start()
    theirs.close()
    try:
        yield result(_watched(ours, worker, context))
    finally:
        ours.close()
        worker.kill()
        worker.join()


def _watched(connection: Connection, worker: SpawnProcess, context: Context) -> WorkerBuild:
    """Follow the worker to its end, or to where it ends otherwise."""
    deadline = time.monotonic() + min(LONGEST_S, context.budget.seconds_left)
    call = "import"
    while True:
        left_s = deadline - time.monotonic()
        limit_s = left_s if call == "import" else min(HANG_S, left_s)
        if not connection.poll(max(0.0, limit_s)):
            if limit_s < HANG_S or call == "import":
                return WorkerBuild("unknown", call, "there was too little time for a worker process")
            return WorkerBuild("hung", call, f"did not come back in {limit_s:g} s")
        try:
            told = json.loads(connection.recv_bytes())
        except EOFError:
            worker.join(5.0)
            code = worker.exitcode
            died = f"was killed by signal {-code}" if code is not None and code < 0 else f"ended with exit code {code}"
            return WorkerBuild("died", call, died)
        if told["type"] == "raised":
            return WorkerBuild("raised", call, told["error"], told["details"])
        if told["type"] == "done":
            return WorkerBuild("done", call, "")
        call = told["call"]


def _work(connection: Connection, spec: str) -> None:
    import traceback

    def tell(**message: Any) -> None:
        connection.send_bytes(json.dumps(message).encode())

    def enter(call: str) -> None:
        tell(type="call", call=call)

    try:
        _live(json.loads(spec), enter)
    except BaseException as error:
        # `SystemExit` too: an environment may raise anything.
        tell(type="raised", error=describe(error), details=traceback.format_exc())
    else:
        tell(type="done")


def _live(spec: dict[str, Any], enter: Any) -> None:
    from rlctl import env_spec, registry
    from rlctl.check_env.actions import actions

    enter("load")
    made_from = env_spec.EnvSpec(**spec)
    registry.load(made_from.task)
    enter("build")
    env = made_from.make()
    enter("reset")
    env.reset()
    enter("step")
    env.step(next(actions(env.action_space, "random", FIRST_SEED)))
    enter("close")
    with contextlib.suppress(Exception):  # closing is tried elsewhere
        env.close()
