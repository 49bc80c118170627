"""The process of a worker, started by `process_pool.py`; imports no torch.

The main process sends a message (`messages.py`); the worker answers once. Observations, actions, rewards, flags and a
policy's numbers are in shared memory.
"""

from __future__ import annotations

import sys
from multiprocessing.connection import Connection
from typing import Any

from rlctl.rollout import messages
from rlctl.rollout.failures import describe_failure
from rlctl.rollout.worker import Worker
from rlctl.rollout.worker_output import write_stderr


def main(connection: Connection, job: dict[str, Any]) -> None:
    """Answer messages until the connection closes."""
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]  # lines are forwarded at once
    try:
        _serve(connection, Worker(messages.Job(**job)))
    except (BrokenPipeError, ConnectionResetError):  # the main process needs no more answers
        return
    except OSError as error:
        reason = error.strerror
        write_stderr(
            f"no connection to rlctl any more ({reason}): did an environment close a file descriptor of rlctl?"
        )
        sys.exit(1)


def _serve(connection: Connection, worker: Worker) -> None:
    while True:
        try:
            message = messages.decode(connection.recv_bytes())
            data = connection.recv_bytes() if isinstance(message, messages.FOLLOWED_BY_BYTES) else b""
        except (EOFError, ConnectionResetError):
            break
        try:
            answer = worker.answer(message, data)
        except BaseException as error:
            answer = messages.Answer(failure=describe_failure(error))
        connection.send_bytes(messages.encode(answer))
    worker.close()
