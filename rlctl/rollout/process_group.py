"""Workers end with all that their environments have started: each is the first of a process group of its own."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator

from rlctl.rollout.process_start import Process


@contextlib.contextmanager
def block_signals() -> Iterator[None]:
    """Hold back signals that ask to stop: a worker that is started meanwhile takes them when it is ready for them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end(process: Process, deadline: float) -> None:
    """Wait until a worker ends or `time.monotonic()` reaches `deadline`; then kill what is left of its group."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=max(0.0, deadline - time.monotonic()))
    with contextlib.suppress(ProcessLookupError, PermissionError):  # nobody is left, or only who has ended
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def end_with_parent(parent: int, lifeline: int) -> None:
    """In a worker: end it and its group when its parent ends, even while an environment is stuck in a step.

    `lifeline` is the descriptor of a pipe whose other end the parent alone holds.
    """
    with contextlib.suppress(AttributeError, OSError):  # Linux only
        # By the system itself: no thread of ours runs while a library is stuck that holds Python's lock.
        fcntl.fcntl(lifeline, fcntl.F_SETOWN, -os.getpid() if os.getpgrp() == os.getpid() else os.getpid())
        fcntl.fcntl(lifeline, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(lifeline, fcntl.F_SETFL, os.O_ASYNC)

    def watch() -> None:
        import select

        with contextlib.suppress(AttributeError, OSError):  # not on every system, nor in every sandbox
            descriptor = os.pidfd_open(parent)
            if os.getppid() == parent:
                select.select([descriptor], [], [])
        while os.getppid() == parent:
            time.sleep(1.0)
        if os.getpgrp() == os.getpid():
            os.killpg(0, signal.SIGKILL)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
