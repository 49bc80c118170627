"""Child processes that environments live in, watched from outside: a crash or a hang is seen, not suffered."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from rlctl.check_env.progress import Progress, Where
from rlctl.check_env.wire import Message, decode, skip
from rlctl.env_spec import EnvSpec
from rlctl.rollout.shared_arrays import anonymous_file

# Started this way a child finds what its parent finds, and the caller's script is not run again.
_BOOTSTRAP = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[3])['sys_path']; "
    "from rlctl.check_env.child_process import main; main()"
)

BUILD_TIMEOUT_S = 60.0
"""How long importing and building may take, unless a step may take longer."""
CHECKER_CALLS = 40
"""A library's checker is one call to us; it makes at most so many calls into the environment."""
CHECKERS_GRACE_S = 5.0
"""How much longer than the other studies the libraries' checkers may take: they have torch to load [s]."""
IDLE_TIMEOUT_S = 300.0
"""How long a child may do nothing with the environment: loading torch on a busy machine, at the worst."""
_POLL_S = 0.1
_KEPT_LINES = 8
_NOT_ITS_OWN = ("pybullet build time", "argv[")
"""Lines that PyBullet prints when it is imported and when it connects."""


class Child:
    """One part of the probe in a process of its own."""

    def __init__(self, part: str, spec: EnvSpec, names: Sequence[str], seconds: float, *, hash_seed: int) -> None:
        self.part = part
        self.printed = 0
        """Lines that were written to stdout."""
        self.first_line = ""
        self.last_lines: deque[str] = deque(maxlen=_KEPT_LINES)
        self.is_done = False
        self._memory = anonymous_file()
        self._progress = Progress(self._memory)
        self._changed = (-1, time.monotonic())
        ours, theirs = socket.socketpair()
        self._names = names
        self._seconds = seconds
        self._started = time.monotonic()
        job = {
            "part": part,
            "spec": dataclasses.asdict(spec),
            "studies": names,
            "seconds": seconds,
            "sys_path": sys.path,
        }
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-c", _BOOTSTRAP, str(theirs.fileno()), str(self._memory), json.dumps(job)],
                pass_fds=(theirs.fileno(), self._memory),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env={**os.environ, **threads, "PYTHONHASHSEED": str(hash_seed)},
                start_new_session=True,  # so that what an environment started can be ended with it
            )
        self.connection = Connection(ours.detach())
        self._readers = [
            threading.Thread(target=self._read, args=(stream, counted), daemon=True)
            for stream, counted in ((self.process.stdout, True), (self.process.stderr, False))
        ]
        for reader in self._readers:
            reader.start()

    def _read(self, stream: Any, counted: bool) -> None:
        for raw in stream:
            line = raw.decode(errors="replace").rstrip()
            if not line or line.startswith(_NOT_ITS_OWN):
                continue
            self.last_lines.append(line)
            if counted:
                self.printed += 1
                self.first_line = self.first_line or line

    @property
    def where(self) -> Where:
        return self._progress.read()

    def hangs(self, env_timeout_s: float) -> bool:
        """Say whether the call that the child is in takes longer than it may."""
        where = self.where
        if where.counter != self._changed[0]:
            self._changed = (where.counter, time.monotonic())
        return time.monotonic() - self._changed[1] > _limit_s(where.call, env_timeout_s)

    def given_up(self) -> Iterator[Message]:
        """Yield what is not known of a library's checker that goes on for too long: only it cannot be told to stop."""
        if self.part == "checkers" and time.monotonic() - self._started > self._seconds + CHECKERS_GRACE_S:
            for name in self._names:
                yield skip(name, f"the libraries' checkers took longer than {self._seconds + CHECKERS_GRACE_S:g} s")

    def death(self) -> str:
        """Wait for the end of a child whose connection closed; say how it ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=5.0)
        code = self.process.poll()
        for reader in self._readers:
            reader.join(timeout=1.0)
        if code is None:
            return "closed its connection"
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"

    def close(self) -> None:
        """End the child and what it started; one that is done gets a moment to end by itself."""
        if self._memory < 0:
            return
        if self.is_done:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout=1.0)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self.connection.close()
        for reader, stream in zip(self._readers, (self.process.stdout, self.process.stderr), strict=True):
            reader.join(timeout=1.0)
            if stream is not None and not reader.is_alive():
                stream.close()
        os.close(self._memory)
        self._memory = -1


def _limit_s(call: str, env_timeout_s: float) -> float:
    if call in ("load", "build"):
        return max(BUILD_TIMEOUT_S, env_timeout_s)
    if call == "check":
        return CHECKER_CALLS * env_timeout_s
    return env_timeout_s if call else IDLE_TIMEOUT_S


def watch(
    children: list[Child],
    receive: Callable[[Message], None],
    env_timeout_s: float,
    on_poll: Callable[[Where], None],
) -> None:
    """Pass on what the children say until all are done, dead or hanging; the latter two become messages too."""
    active = {child.connection: child for child in children}
    while active:
        for ready in wait(list(active), timeout=_POLL_S):
            child = active[ready]  # type: ignore[index]
            try:
                message = decode(child.connection.recv_bytes())
            except (EOFError, OSError):
                receive(_failure(child, "died", child.death()))
                del active[child.connection]
                continue
            if message[0]["type"] == "done":
                child.is_done = True
                del active[child.connection]
            else:
                receive(message)
        for child in list(active.values()):
            if given_up := list(child.given_up()):
                for message in given_up:
                    receive(message)
                child.close()
                del active[child.connection]
            elif child.hangs(env_timeout_s):
                receive(
                    _failure(child, "hung", f"did not come back in {_limit_s(child.where.call, env_timeout_s):g} s")
                )
                child.close()
                del active[child.connection]
                # The checkers would hang in the same call, for much longer.
                for other in [each for each in active.values() if each.part == "checkers"]:
                    other.close()
                    del active[other.connection]
        on_poll(next(iter(active.values()), children[0]).where)


def _failure(child: Child, kind: str, error: str) -> Message:
    where = child.where
    header = {
        "type": "failure",
        "kind": kind,
        "call": where.call or "between calls",
        "part": child.part,
        "phase": where.phase,
        "episode": where.episode,
        "seed": where.seed,
        "step": where.step,
        "error": error,
        "details": "\n".join(child.last_lines) or None,
    }
    return header, {}
