"""Child process of a training: receives a request as JSON, exits with the exit code of `rlctl train`."""

import sys
from collections.abc import Sequence
from multiprocessing.connection import Connection
from types import FrameType
from typing import Any

from rlctl.errors import Interrupted
from rlctl.library_output import redirect_stdout
from rlctl.printed_lines import collect
from rlctl.processes import error_boundary, messages


def main(connection: Connection, request: dict[str, Any], command: Sequence[str]) -> None:
    """Train; send a message when signals can stop the training. `command` is the parent's command line."""
    sys.argv[:] = command
    error_boundary.prepare_streams()
    code = error_boundary.run(lambda: _train(connection, request))
    error_boundary.limit_exit_handlers(code)
    sys.exit(code)


def _train(connection: Connection, content: dict[str, Any]) -> int:
    from rlctl.runs.train_request import TrainRequest
    from rlctl.training.signals import HandledSignals

    with HandledSignals(_interrupt), collect(), redirect_stdout():
        messages.send(connection, "ready")
        from rlctl.launching.train import run_training

        run_training(TrainRequest.from_json(content))
    return 0


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise Interrupted("interrupted before the training began", number)
