"""Fresh Python interpreters as child processes, each in a process group of its own, with a connection to it.

Never forks: a process that holds PyBullet or torch cannot be forked safely. (Tests fork from one that does not run any
environment: `process_start.set_default_start`.) What a child and its own children print
goes to descriptors that the caller gives, for example to a `LineReader`.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Any

from rlctl.rollout.process_group import block_signals, end, end_with_parent
from rlctl.rollout.process_start import StartProcess, default_start

# Started this way a child finds the modules that its parent finds, and the caller's script is not run again.
# Ctrl-C and `kill` may reach a child too, but its parent decides: ignored before anything slow is imported, and held
# back until then. A handler, not SIG_IGN, because that would be inherited by what an environment starts.
_BOOTSTRAP = (
    "import signal; numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP); "
    "[signal.signal(number, lambda *_: None) for number in numbers]; "
    "signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers); "
    "import json, sys; job = json.loads(sys.argv[1]); sys.path[:] = job['sys_path']; "
    "from rlctl.rollout.child_process import run_main; run_main(job)"
)
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class ChildProcess:
    """A process that runs `main(connection, **arguments)` of a module; `close` kills it and all that it has started.

    It also ends, with its group, when its parent does. `environment` goes over the variables of this process; numeric
    libraries get one thread. `descriptors` stay open under the same numbers. Raises `OSError` if it cannot be started.
    """

    def __init__(
        self,
        main: str,
        arguments: Mapping[str, Any],
        *,
        stdout: int,
        stderr: int,
        descriptors: Sequence[int] = (),
        environment: Mapping[str, str] | None = None,
        start: StartProcess | None = None,
    ) -> None:
        """`main` is "package.module:function"; `arguments` are what JSON can hold."""
        ours, theirs = socket.socketpair()
        # A pipe that nobody writes to: its end shows the child that this process is gone.
        lifeline, self._lifeline = os.pipe()
        job = {
            "main": main,
            "arguments": dict(arguments),
            "sys_path": sys.path,
            "parent": os.getpid(),
            "connection": theirs.fileno(),
            "lifeline": lifeline,
        }
        try:
            with theirs, open(lifeline, "rb"), block_signals():
                self.process = (start or default_start())(
                    [sys.executable, "-c", _BOOTSTRAP, json.dumps(job)],
                    pass_fds=(theirs.fileno(), lifeline, *descriptors),
                    stdin=subprocess.DEVNULL,
                    stdout=stdout,
                    stderr=stderr,
                    env={**os.environ, **_ONE_THREAD, **(environment or {})},
                    process_group=0,  # so that what an environment starts can be ended with it
                )
        except BaseException:
            ours.close()
            os.close(self._lifeline)
            raise
        self.connection = Connection(ours.detach())

    def describe_end(self, timeout_s: float = 5.0) -> str:
        """Wait for the end of a child whose connection has closed, and return how it ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=timeout_s)
        code = self.process.poll()
        if code is None:
            return "closed its connection"
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"

    def close(self, grace_s: float = 0.0) -> None:
        """Kill the process group; the child gets `grace_s` seconds to end by itself. A second call does nothing."""
        if self._lifeline < 0:
            return
        end(self.process, time.monotonic() + grace_s)
        self.connection.close()
        os.close(self._lifeline)  # not before it has ended: this kills it
        self._lifeline = -1


def run_main(job: dict[str, Any]) -> None:
    """In the child: call what the parent asked for."""
    end_with_parent(job["parent"], job["lifeline"])
    module, _, name = job["main"].partition(":")
    getattr(importlib.import_module(module), name)(Connection(job["connection"]), **job["arguments"])


def anonymous_file() -> int:
    """Return the descriptor of a new file without a name."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("rlctl-workers")
    import tempfile  # only where there is no memory for it

    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


class LineReader:
    """Hands each line that is written to `descriptor` to a function, in a thread of its own.

    Close `descriptor` (`close_descriptor`) once the children that write to it have been started. A line of more than
    `max_bytes` comes in parts.
    """

    def __init__(self, receive: Callable[[str], None], max_bytes: int = -1) -> None:
        read_end, self.descriptor = os.pipe()
        self._receive = receive
        self._max_bytes = max_bytes
        self._thread = threading.Thread(target=self._read, args=(read_end,), daemon=True)
        self._thread.start()

    def _read(self, read_end: int) -> None:
        with os.fdopen(read_end, "rb") as pipe:
            while line := pipe.readline(self._max_bytes):
                self._receive(line.decode(errors="replace").rstrip("\r\n"))

    def close_descriptor(self) -> None:
        """Close this process's end of the pipe: the thread ends with the last child that holds it."""
        os.close(self.descriptor)

    def wait(self, timeout_s: float = 1.0) -> None:
        """Wait until everything that was written has been read, if that is soon."""
        self._thread.join(timeout=timeout_s)
