"""Fresh Python interpreters as child processes, each in a process group of its own, with a connection to it.

Never forks: a process that holds PyBullet or torch cannot be forked safely. (Tests fork from one that does not run any
environment: `set_start`.) What a child and its own children print goes to descriptors that the caller gives, for
example to a `LineReader`.
"""

from __future__ import annotations

import contextlib
import fcntl
import importlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Any

# Started this way a child finds the modules that its parent finds, and the caller's script is not run again.
# Ctrl-C and `kill` may reach a child too, but its parent decides: ignored before anything slow is imported, and held
# back until then. A handler, not SIG_IGN, because that would be inherited by what an environment starts.
_BOOTSTRAP = (
    "import signal; numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP); "
    "[signal.signal(number, lambda *_: None) for number in numbers]; "
    "signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers); "
    "import json, sys; job = json.loads(sys.argv[1]); sys.path[:] = job['sys_path']; "
    "from rlctl.processes.child_process import run_main; run_main(job)"
)
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


StartProcess = Callable[..., "subprocess.Popen[bytes]"]
"""Takes what `subprocess.Popen` takes, and returns what has its `pid`, `poll` and `wait`."""
_start: StartProcess = subprocess.Popen


def start_process(command: Sequence[str], **options: Any) -> subprocess.Popen[bytes]:
    """Start a process as `subprocess.Popen` does, or as `set_start` has it."""
    return _start(command, **options)


def set_start(start: StartProcess) -> None:
    """Set how this process starts all others: tests, which start many, fork them from a process made for it."""
    global _start
    _start = start


class ChildProcess:
    """A process that runs `main(connection, **arguments)` of a module; `close` kills it and all that it has started.

    It also ends, with its group, when its parent does; numeric libraries get one thread, except without `one_thread`.
    Raises `OSError` if it cannot be started.
    """

    def __init__(self, main: str, arguments: Mapping[str, Any], *, one_thread: bool = True, **options: Any) -> None:
        """`main` is "package.module:function"; `arguments` are what JSON can hold; `options` are those of
        `subprocess.Popen`, of which `pass_fds` and `env` are added to what every child gets.
        """
        ours, theirs = socket.socketpair()
        # A pipe that nobody writes to: its end shows the child that this process is gone.
        lifeline, self._lifeline = os.pipe()
        job = {
            "main": main,
            "arguments": dict(arguments),
            "sys_path": sys.path,
            "connection": theirs.fileno(),
            "lifeline": lifeline,
        }
        options["pass_fds"] = (theirs.fileno(), lifeline, *options.get("pass_fds", ()))
        options["env"] = {**os.environ, **(_ONE_THREAD if one_thread else {}), **options.get("env", {})}
        try:
            with theirs, open(lifeline, "rb"), _block_signals():
                self.process = start_process(
                    [sys.executable, "-c", _BOOTSTRAP, json.dumps(job)],
                    stdin=subprocess.DEVNULL,
                    process_group=0,  # so that what an environment starts can be ended with it
                    **options,
                )
        except BaseException:
            ours.close()
            os.close(self._lifeline)
            raise
        self.connection = Connection(ours.detach())

    def describe_end(self) -> str:
        """Wait for the end of a child whose connection has closed, and return how it ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=5.0)
        code = self.process.poll()
        if code is None:
            return "closed its connection"
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"

    def close(self, grace_s: float = 0.0) -> None:
        """Kill the process group; the child gets `grace_s` seconds to end by itself. A second call does nothing."""
        if self._lifeline < 0:
            return
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=grace_s)
        with contextlib.suppress(ProcessLookupError, PermissionError):  # nobody is left, or only who has ended
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self.connection.close()
        os.close(self._lifeline)  # not before it has ended: this kills it
        self._lifeline = -1


def run_main(job: dict[str, Any]) -> None:
    """In the child: call what the parent asked for."""
    _end_with_parent(job["lifeline"])
    module, _, name = job["main"].partition(":")
    getattr(importlib.import_module(module), name)(Connection(job["connection"]), **job["arguments"])


@contextlib.contextmanager
def _block_signals() -> Iterator[None]:
    """Hold back signals that ask to stop: a child that is started meanwhile takes them when it is ready for them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent(lifeline: int) -> None:
    """In a child: end it and its group when its parent ends, even while an environment is stuck in a step.

    `lifeline` is the descriptor of a pipe whose other end the parent alone holds.
    """
    with contextlib.suppress(AttributeError, OSError):  # Linux only
        # By the system itself: no thread of ours runs while a library is stuck that holds Python's lock.
        fcntl.fcntl(lifeline, fcntl.F_SETOWN, -os.getpid() if os.getpgrp() == os.getpid() else os.getpid())
        fcntl.fcntl(lifeline, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(lifeline, fcntl.F_SETFL, os.O_ASYNC)

    def watch() -> None:
        with contextlib.suppress(OSError):  # an environment has closed it
            os.read(lifeline, 1)  # until there is no other end any more
        if os.getpgrp() == os.getpid():
            os.killpg(0, signal.SIGKILL)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


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


MAX_LINE_BYTES = 1000  # bytes
MAX_LINES_PER_S = 100


class LineFilter:
    """Hands lines that environments print to `receive`, at a rate that can be read.

    A process that prints blocks while nobody reads, so lines that come too fast are counted and dropped, and if
    `receive` raises `OSError`, as a closed stderr does, all that follow.
    """

    def __init__(self, receive: Callable[[str], None]) -> None:
        self._receive = receive
        self._closed = False
        self._last = ""
        self._second = 0
        self._lines = 0  # in this second
        self._left_out = 0
        self._bullet_head = ""
        self._bullet_warnings: set[str] = set()

    def line(self, text: str) -> None:
        """Take a line."""
        # Many environments print the same line; once is enough.
        if text == self._last or text.startswith("pybullet build time"):
            return
        # PyBullet's warnings have two lines, the second of which says what is wrong.
        if text.startswith(("b3Warning[", "b3Error[")):
            self._bullet_head = text
            return
        if self._bullet_head:
            text, self._bullet_head = f"{self._bullet_head} {text}", ""
            if text in self._bullet_warnings:
                return
            self._bullet_warnings.add(text)
        self._last = text
        second = int(time.monotonic())
        if second != self._second:
            self.end()
            self._second, self._lines = second, 0
        self._lines += 1
        if self._lines > MAX_LINES_PER_S:
            self._left_out += 1
        else:
            self._report(replace_control_characters(text))

    def end(self) -> None:
        """Report how many lines were left out, if any."""
        if self._left_out:
            self._report(f"({self._left_out:,} more lines of what environments print are left out)")
        self._left_out = 0

    def _report(self, text: str) -> None:
        try:
            if not self._closed:
                self._receive(text)
        except OSError:
            self._closed = True


def replace_control_characters(text: str) -> str:
    """Return a line without what would move a terminal's cursor, or worse."""
    return "".join(each if each.isprintable() or each == "\t" else "\ufffd" for each in text)


def write_stderr(text: str) -> None:
    """Write a line beside what environments print."""
    # Not by print: an environment may have closed or replaced what that writes to.
    with contextlib.suppress(OSError):
        os.write(2, f"{text}\n".encode(errors="replace"))
