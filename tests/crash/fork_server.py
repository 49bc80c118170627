"""A process that has imported what a training imports, and forks for each training: `python -m` this, then JSON lines.

Importing torch takes more time than a small training. Each trial is a session of its own; what it leaves behind
becomes a child of the server, which so finds orphans. Environments live in processes of their own as ever, which are
forked too unless a trial wants real ones: they import as much.
"""

import ctypes
import json
import os
import signal
import sys
import time
from pathlib import Path

_IMPORTED_LATE = (
    *("torch._dynamo", "torch.utils.tensorboard", "rlctl.rollout.worker_process", "rlctl.cli", "rich.console"),
    "rlctl.run.env_info",
)
"""What a training imports when it comes to need it; one that is missing here costs time only."""
_PR_SET_CHILD_SUBREAPER = 36
_PATIENCE_S = 10.0
"""How long a process may outlive its training."""


def main():
    requests, answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    _import_what_trainings_import()
    for line in requests:
        answer = _trial(json.loads(line), (requests, answers))
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def _import_what_trainings_import():
    import gc
    import importlib
    import pkgutil

    import rlctl.train

    for module in pkgutil.iter_modules(rlctl.train.__path__, "rlctl.train."):
        importlib.import_module(module.name)
    for name in _IMPORTED_LATE:
        importlib.import_module(name)
    gc.collect()
    gc.freeze()


def _trial(request, descriptors):
    folder, plan = Path(request["folder"]), request["plan"]
    started = time.monotonic()
    process = os.fork()
    if process == 0:
        for each in descriptors:
            os.close(each.fileno())
        _become(request["arguments"], folder, plan)
    status = _wait(process, folder, plan.get("send", []))
    ended = time.monotonic()
    code = os.waitstatus_to_exitcode(status)
    orphans = _orphans(ended + _PATIENCE_S)
    return {"code": code, "seconds": ended - started, "orphans": orphans}


def _wait(process, folder, send):
    """Send signals to a process, [when, number] each, and wait for its end; `when` is in seconds, or a file to be."""
    started = time.monotonic()
    for when, number in send:
        while not (folder / when).exists() if isinstance(when, str) else time.monotonic() < started + when:
            found, status = os.waitpid(process, os.WNOHANG)
            if found:
                return status
            time.sleep(0.001)
        os.kill(process, number)
    return os.waitpid(process, 0)[1]


def _orphans(deadline):
    """Wait for every other process there is below this one; return the commands of those that do not end."""
    import psutil

    try:
        while time.monotonic() < deadline:
            if not os.waitpid(-1, os.WNOHANG)[0]:
                time.sleep(0.002)
    except ChildProcessError:
        return []
    left = psutil.Process().children(recursive=True)
    told = [f"{each.pid} {' '.join(each.cmdline())[:80]}" for each in left]
    for each in left:
        each.kill()
    psutil.wait_procs(left, timeout=5.0)
    return told


def _become(arguments, folder, plan):
    """Be the training; does not return."""
    code = 70
    try:
        os.setsid()
        os.chdir(folder)
        _redirect(folder)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        from tests.crash import inside

        code = inside.run(arguments, folder, plan)
    except SystemExit as end:
        code = end.code
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code if isinstance(code, int) else 1)


def _redirect(folder):
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        file = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(file, descriptor)
        os.close(file)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)


if __name__ == "__main__":
    main()
