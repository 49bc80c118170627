"""What runs in a child process of check-env: one part of the probe, told to the parent message by message."""

from __future__ import annotations

import inspect
import json
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from multiprocessing.connection import Connection
from typing import Any

from rlctl import env_spec, registry
from rlctl.check_env.library_checkers import library_checkers
from rlctl.check_env.probe import instances, probe
from rlctl.check_env.progress import Progress
from rlctl.check_env.wire import Message, encode
from rlctl.errors import RlctlError, TaskError, UsageError

PARTS: Mapping[str, Callable[[Callable[[], Any], Progress], Iterator[Message]]] = {
    "probe": probe,
    "instances": instances,
    "checkers": library_checkers,
}


def main() -> None:
    """Run one part. Arguments: connection, descriptor of the progress memory, and the job as JSON."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    connection = Connection(int(sys.argv[1]))
    progress = Progress(int(sys.argv[2]))
    job = json.loads(sys.argv[3])
    threading.Thread(target=_end_with_parent, args=(connection,), daemon=True).start()
    for header, arrays in run_part(job["part"], env_spec.EnvSpec(job["task"], job["parameters"]), progress):
        connection.send_bytes(encode(header, arrays))
    connection.send_bytes(encode({"type": "done"}, {}))


def _end_with_parent(connection: Connection) -> None:
    try:
        connection.recv_bytes()  # the parent never sends: this returns when the parent is gone
    except (EOFError, OSError):
        os._exit(1)


def run_part(part: str, spec: env_spec.EnvSpec, progress: Progress | None = None) -> Iterator[Message]:
    """Yield the messages of one part; an environment that cannot be built is one of them."""
    progress = progress or Progress()
    stage = "import"

    def make() -> Any:
        nonlocal stage
        # Loaded before it is built, to tell an import error from a constructor's.
        progress.enter("load")
        registry.load(spec.task)
        stage = "constructor"
        progress.enter("build")
        env = spec.make()
        progress.leave()
        return env

    try:
        for header, arrays in PARTS[part](make, progress):
            yield {**header, "part": part}, arrays
    except UsageError as error:
        yield {"type": "usage_error", "kind": type(error).__name__, "message": str(error), "part": part}, {}
    except RlctlError as error:
        yield {**_load_error(spec, stage, error), "part": part}, {}
    except Exception:
        # The environment's own exceptions were caught where it was called, so this one is ours.
        yield {"type": "crashed", "traceback": traceback.format_exc(), "part": part}, {}


def _load_error(spec: env_spec.EnvSpec, stage: str, error: RlctlError) -> dict[str, Any]:
    missing = []
    if stage == "constructor":
        if isinstance(error.__cause__, TypeError):
            missing = _missing_arguments(str(error.__cause__))
        # The registry's own verdict; what the constructor raised comes with its traceback.
        elif isinstance(error, TaskError) and error.details is None and not _is_task(spec):
            stage = "kind"
    return {
        "type": "load_error",
        "stage": stage,
        "message": str(error),
        "details": error.details,
        "missing": missing,
    }


def _is_task(spec: env_spec.EnvSpec) -> bool:
    return inspect.isclass(loaded := registry.load(spec.task)) and registry.is_task(loaded)


def _missing_arguments(message: str) -> list[str]:
    found = re.search(r"missing \d+ required .*?arguments?: (.*)", message)
    return re.findall(r"'(\w+)'", found.group(1)) if found else []
