"""What runs in a child process of check-env: its part of the studies, told to the parent message by message."""

from __future__ import annotations

import inspect
import json
import os
import re
import signal
import sys
import threading
import time
import traceback
from collections.abc import Collection, Iterator
from multiprocessing.connection import Connection
from typing import Any

from rlctl import env_spec, registry
from rlctl.check_env import studies
from rlctl.check_env.built import built
from rlctl.check_env.context import Context
from rlctl.check_env.failures import EnvironmentRaised, failure
from rlctl.check_env.instance import Budget
from rlctl.check_env.missing_files import missing_file
from rlctl.check_env.progress import Progress
from rlctl.check_env.wire import Message, encode, skip
from rlctl.errors import NoSuchClassError, OldGymError, RlctlError, TaskError, UsageError


def main() -> None:
    """Run one part. Arguments: connection, descriptor of the progress memory, and the job as JSON."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    connection = Connection(int(sys.argv[1]))
    progress = Progress(int(sys.argv[2]))
    job = json.loads(sys.argv[3])
    threading.Thread(target=_end_with_parent, args=(connection,), daemon=True).start()
    spec = env_spec.EnvSpec(**job["spec"])
    for header, arrays in run_part(job["part"], spec, job["studies"], job["seconds"], progress):
        connection.send_bytes(encode(header, arrays))
    connection.send_bytes(encode({"type": "done"}, {}))


def _end_with_parent(connection: Connection) -> None:
    try:
        connection.recv_bytes()  # the parent never sends: this returns when the parent is gone
    except (EOFError, OSError):
        os._exit(1)


def run_part(
    part: str,
    spec: env_spec.EnvSpec,
    names: Collection[str] | None = None,
    seconds: float = studies.PART_S,
    progress: Progress | None = None,
) -> Iterator[Message]:
    """Yield the messages of one part, all its studies by default; an environment that cannot be built is one."""
    context = Context(spec, progress)
    chosen = studies.of_part(part, studies.names() if names is None else names)
    try:
        for header, arrays in _part(part, context, chosen, seconds):
            yield {**header, "part": part}, arrays
    except (NoSuchClassError, OldGymError) as error:
        yield {**_load_error(context, error), "part": part}, {}
    except UsageError as error:
        yield {"type": "usage_error", "kind": type(error).__name__, "message": str(error), "part": part}, {}
    except RlctlError as error:
        yield {**_load_error(context, error), "part": part}, {}


def _part(part: str, context: Context, chosen: list[studies.Study], seconds: float) -> Iterator[Message]:
    if part == "probe":
        instance = context.first()
        yield built(instance)
        if not _can_act(instance.env):
            for study in chosen:
                yield skip(study.name, "its action space is no Gymnasium space")
            return
    yield from _studies(context, chosen, seconds)
    yield from context.close()


def _studies(context: Context, chosen: list[studies.Study], seconds: float) -> Iterator[Message]:
    """Run the studies; each has its share of the time that those before it have left."""
    end = time.monotonic() + seconds
    shares = sum(study.share for study in chosen)
    for study in chosen:
        begun = time.monotonic()
        if begun > end:
            yield skip(study.name, f"the studies before it took the {seconds:g} s there are")
            continue
        context.progress.phase(study.name)
        context.budget = Budget(begun + (end - begun) * study.share / shares)
        shares -= study.share
        try:
            yield from study.run(context)
        except EnvironmentRaised as error:
            yield failure(error, context.progress), {}
        except RlctlError:
            raise
        except Exception:
            # The environment's own exceptions were caught where it was called, so this one is ours.
            yield {"type": "crashed", "study": study.name, "traceback": traceback.format_exc()}, {}
        yield {"type": "studied", "study": study.name, "seconds": time.monotonic() - begun}, {}


def _can_act(env: Any) -> bool:
    from gymnasium import spaces

    return isinstance(env.action_space, spaces.Space)


def _load_error(context: Context, error: RlctlError) -> dict[str, Any]:
    cause = error.__cause__
    missing = _missing_arguments(str(cause)) if isinstance(cause, TypeError) else []
    file = missing_file(cause)
    kind = context.stage
    if isinstance(error, NoSuchClassError):
        kind = "class"
    elif isinstance(error, OldGymError) or _imports_old_gym(cause):
        kind = "old gym"
    elif file is not None:
        kind = "file"
    elif kind == "constructor" and missing:
        kind = "arguments"
    elif (
        kind == "constructor" and isinstance(error, TaskError) and error.details is None and not _is_task(context.spec)
    ):
        kind = "no environment"  # the registry's own verdict; what the constructor raised comes with its traceback
    return {
        "type": "load_error",
        "kind": kind,
        "message": str(error),
        "details": error.details,
        "missing": missing,
        "file": file,
    }


def _imports_old_gym(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] == "gym":
            return True
        error = error.__cause__ or error.__context__
    return False


def _is_task(spec: env_spec.EnvSpec) -> bool:
    return inspect.isclass(loaded := registry.load(spec.task)) and registry.is_task(loaded)


def _missing_arguments(message: str) -> list[str]:
    found = re.search(r"missing \d+ required .*?arguments?: (.*)", message)
    return re.findall(r"'(\w+)'", found.group(1)) if found else []
