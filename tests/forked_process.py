"""What a forked process does: it takes over what its caller gives it, runs its command, and ends."""

import contextlib
import fcntl
import importlib
import os
import runpy
import signal
import struct
import sys
import time
import traceback

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def become(request, received, ready, set_up):
    """Be the new process; does not return. `set_up` is called before the command is run."""
    code = 70
    try:
        if request["session"]:
            os.setsid()
        elif request["process_group"] is not None:
            os.setpgid(0, request["process_group"])
        while os.getppid() == request["between"]:  # until it has ended
            time.sleep(0.0001)
        os.write(ready, struct.pack("i", os.getpid()))
        _take_descriptors(request["descriptors"], received)
        _take_surroundings(request)
        set_up()
        code = _run(request["command"][1:])
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):
                stream.flush()
        os._exit(code)


def _take_descriptors(numbers, received):
    lowest = max(*numbers, *received) + 1
    moved = [fcntl.fcntl(each, fcntl.F_DUPFD, lowest) for each in received]
    os.closerange(3, lowest)
    for number, descriptor in zip(numbers, moved, strict=True):
        os.dup2(descriptor, number)
        os.close(descriptor)
    sys.stdin = os.fdopen(0, closefd=False)
    sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
    sys.stderr = os.fdopen(2, "w", encoding="utf-8", errors="backslashreplace", buffering=1, closefd=False)


def _take_surroundings(request):
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    os.sched_setaffinity(0, request["cores"])
    signal.pthread_sigmask(signal.SIG_SETMASK, request["blocked"])  # first: what is held back must not end it
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in SIGNALS[1:]:
        signal.signal(number, signal.SIG_DFL)
    arguments = request["command"][1:]
    first = [] if arguments[0] == "-P" else [os.getcwd() if arguments[0] == "-m" else ""]
    given = [folder for folder in request["env"].get("PYTHONPATH", "").split(os.pathsep) if folder]
    sys.path[:] = [*first, *given, *sys.path[1:]]
    importlib.invalidate_caches()
    import numpy as np

    np.random.seed()  # noqa: NPY002 (every fork would draw the same)


def _run(arguments):
    """Run `[-P] -c code ...` or `[-P] -m module ...`; return the exit code."""
    kind, what, *rest = arguments[1:] if arguments[0] == "-P" else arguments
    sys.argv = [kind, *rest]
    try:
        if kind == "-m":
            runpy.run_module(what, run_name="__main__", alter_sys=True)
        else:
            exec(compile(what, "<string>", "exec"), {"__name__": "__main__"})
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):
            return end.code or 0
        print(end.code, file=sys.stderr)
        return 1
    except BaseException:
        traceback.print_exc()
        return 1
    return 0
