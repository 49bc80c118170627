"""New Python interpreters as child processes, each with its own process group and a connection.

Never forks: a process with PyBullet or torch cannot be forked safely. The caller chooses where a child prints, for
example to a `LineReader` of `rlctl.printed_lines`.
"""

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
import uuid
from collections.abc import Callable, Iterator, Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from rlctl.processes import messages

# This way a child finds the same modules as its parent (-P: none of the current folder), and does not run the caller's
# script again.
# Ctrl-C, `kill` and a cluster's warning may reach a child too, but its parent decides what happens: the child blocks
# these signals until it ignores them, before any slow import. It uses a handler because processes inherit SIG_IGN.
_BOOTSTRAP = (
    "import signal; numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2); "
    "[signal.signal(number, lambda *_: None) for number in numbers]; "
    "signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers); "
    "import json, sys; job = json.loads(sys.argv[1]); sys.path[:] = job['sys_path']; "
    "from rlctl.processes.child_process import run_main; run_main(job)"
)
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
"""Signals that ask a training to stop; clusters send the last two before a job's time is over."""
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_MARK = "RLCTL_CHILD_PROCESSES"
"""Variable with the identifiers of the children in which a process runs; its own children inherit it."""
_MOST_ROUNDS = 5  # what is killed may have started others in the meantime
_EXEC_S = 0.02  # [s]
"""A process that has just been started has its environment after that time."""
start_process: Callable[..., "subprocess.Popen[bytes]"] = subprocess.Popen
"""Starts a child. Tests start many: they replace it by a function that forks a prepared process."""


class ChildProcess:
    """A process that runs `main(connection, **arguments)` of a module; `close` kills it and what it has started.

    These are its process group and, on Linux, processes in sessions of their own. The group also ends when the parent
    does. With `one_thread` numeric libraries use one thread. Raises `OSError` if the process cannot be started.
    """

    def __init__(self, main: str, arguments: Mapping[str, Any], *, one_thread: bool = True, **options: Any) -> None:
        """`main` is "package.module:function"; `arguments` are sent as a message; `options` are those of
        `subprocess.Popen`; `pass_fds` and `env` are added to the defaults.
        """
        ours, theirs = socket.socketpair()
        # Nobody writes to this pipe; when it closes, the child knows that this process has ended.
        lifeline, self._lifeline = os.pipe()
        job = {"main": main, "sys_path": sys.path, "connection": theirs.fileno(), "lifeline": lifeline}
        options["pass_fds"] = (theirs.fileno(), lifeline, *options.get("pass_fds", ()))
        self._identifier = uuid.uuid4().hex
        mark = {_MARK: f"{os.environ.get(_MARK, '')}:{self._identifier}"}
        options["env"] = {**os.environ, **(_ONE_THREAD if one_thread else {}), **options.get("env", {}), **mark}
        try:
            with theirs, open(lifeline, "rb"), _block_signals():
                self.process = start_process(
                    [sys.executable, "-P", "-c", _BOOTSTRAP, json.dumps(job)],
                    stdin=subprocess.DEVNULL,
                    process_group=0,  # so that processes started by an environment can be killed too
                    **options,
                )
        except BaseException:
            ours.close()
            os.close(self._lifeline)
            raise
        self.connection = Connection(ours.detach())
        with contextlib.suppress(ChildEndedError):  # the first `receive` raises it again
            self.send(dict(arguments))

    def send(self, message: Any) -> None:
        """Send a message; raises `ChildEndedError` if the child has ended."""
        try:
            messages.send(self.connection, message)
        except OSError:
            raise ChildEndedError(self.describe_end()) from None

    def receive(self) -> Any:
        """Wait for a message; raises `ChildEndedError` if the child ends first, or writes something else."""
        try:
            return messages.receive(self.connection)
        except messages.UnreadableMessageError as error:
            raise ChildEndedError(f"wrote invalid data to its connection: {error}") from None
        except (EOFError, OSError):
            raise ChildEndedError(self.describe_end()) from None

    def describe_end(self) -> str:
        """Wait for the end of a child whose connection is closed; return how it ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=5.0)
        code = self.process.poll()
        if code is None:
            return "closed its connection"
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"

    def close(self, grace_s: float = 0.0) -> None:
        """Kill the child and what it has started, after `grace_s` seconds in which it may end by itself.

        A second call does nothing.
        """
        if self._lifeline < 0:
            return
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=grace_s)
        with contextlib.suppress(ProcessLookupError, PermissionError):  # no process is left, or only ended ones
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        _kill_marked(self._identifier)
        self.connection.close()
        os.close(self._lifeline)  # only now: closing it kills the child
        self._lifeline = -1


class ChildEndedError(Exception):
    """A child process has ended or sends invalid data; the message says which."""


class Standstill:
    """Measures for how long a value that shows a child's progress has not changed."""

    def __init__(self, read_progress: Callable[[], Any], clock: Callable[[], float] = time.monotonic) -> None:
        self._read_progress, self._clock = read_progress, clock
        self._progress, self._since = read_progress(), clock()

    def seconds(self) -> float:
        """Return how many seconds of the clock ago a change was last noticed."""
        progress, now = self._read_progress(), self._clock()
        if progress != self._progress:
            self._progress, self._since = progress, now
        return now - self._since


def _kill_marked(identifier: str) -> None:
    """Kill the processes that a child has started in sessions of their own, where the system lists processes."""
    for _ in range(_MOST_ROUNDS):
        marked, starting = _find_marked(identifier)
        for pid in marked:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        if not marked:
            if not starting:
                return
            time.sleep(_EXEC_S)


def _find_marked(identifier: str) -> tuple[list[int], bool]:
    """Return the processes with an identifier, and whether one is starting, whose environment cannot be seen yet."""
    found, starting = [], False
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended, or is another user's
            environment = (folder / "environ").read_bytes()
            if identifier.encode() in environment:
                found.append(int(folder.name))
            elif not environment:
                starting |= bool(os.readlink(folder / "exe"))  # raises for what is no program, such as a zombie
    return found, starting


def run_main(job: dict[str, Any]) -> None:
    """In the child: call the function that the parent chose."""
    _end_with_parent(job["lifeline"])
    module, _, name = job["main"].partition(":")
    main, connection = getattr(importlib.import_module(module), name), Connection(job["connection"])
    main(connection, **messages.receive(connection))


@contextlib.contextmanager
def _block_signals() -> Iterator[None]:
    """Block signals that ask to stop: a child started meanwhile receives them when its handlers are set."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent(lifeline: int) -> None:
    """In a child: end it and its group when its parent ends, even while an environment is stuck in a step.

    `lifeline` is the descriptor of a pipe whose other end only the parent has.
    """
    with contextlib.suppress(AttributeError, OSError):  # Linux only
        # The system sends the signal: a thread could not run while a stuck library holds Python's lock.
        fcntl.fcntl(lifeline, fcntl.F_SETOWN, -os.getpid() if os.getpgrp() == os.getpid() else os.getpid())
        fcntl.fcntl(lifeline, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(lifeline, fcntl.F_SETFL, os.O_ASYNC)

    def watch() -> None:
        with contextlib.suppress(OSError):  # an environment has closed it
            os.read(lifeline, 1)  # returns when the other end is closed
        if os.getpgrp() == os.getpid():
            os.killpg(0, signal.SIGKILL)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def anonymous_file() -> int:
    """Return the descriptor of a new unnamed file, in memory where the system can."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("rlctl-workers")
    import tempfile

    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def grow_anonymous_file(descriptor: int, size: int) -> None:
    """Let a file of `anonymous_file` have at least `size` bytes; an `OSError` names what has no path."""
    if os.fstat(descriptor).st_size >= size:
        return
    try:
        os.ftruncate(descriptor, size)
    except OSError as error:
        error.filename = f"memory of {size:,} bytes that processes share"
        raise
