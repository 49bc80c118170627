"""The child process that an environment lives in: a crash or a hang is seen, not suffered."""

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
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

from rlctl.check_env.progress import Progress, Where
from rlctl.env_spec import EnvSpec
from rlctl.rollout.shared_arrays import anonymous_file

# Started this way a child finds what its parent finds, and the caller's script is not run again.
_BOOTSTRAP = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[3])['sys_path']; "
    "from rlctl.check_env.child_process import main; main()"
)

BUILD_TIMEOUT_S = 60.0
"""How long importing and building may take, unless a step may take longer."""
FIRST_CALL_TIMEOUT_S = 30.0
"""How long the first reset and the first step of a process may take, where much is compiled or loaded [s]."""
CHECKER_CALLS = 40
"""A library's checker is one call to us; it makes at most so many calls into the environment."""
IDLE_TIMEOUT_S = 300.0
"""How long a child may do nothing with the environment: loading torch on a busy machine, at the worst."""
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
        self.names = names
        self.seconds = seconds
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

    def hangs(self, env_timeout_s: float) -> str | None:
        """Say so if the call that the child is in takes longer than it may."""
        where = self.where
        if where.counter != self._changed[0]:
            self._changed = (where.counter, time.monotonic())
        limit_s = _limit_s(where, env_timeout_s)
        return f"did not come back in {limit_s:g} s" if time.monotonic() - self._changed[1] > limit_s else None

    @property
    def is_over_time(self) -> bool:
        """Whether it is a library's checker that goes on for too long: only such a one cannot be told to stop."""
        return self.part == "checkers" and time.monotonic() - self._started > self.seconds

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


def _limit_s(where: Where, env_timeout_s: float) -> float:
    call = where.call
    if where.is_first and call in ("reset", "step"):
        return max(FIRST_CALL_TIMEOUT_S, env_timeout_s)
    if call in ("load", "build"):
        return max(BUILD_TIMEOUT_S, env_timeout_s)
    if call == "check":
        return CHECKER_CALLS * env_timeout_s
    return env_timeout_s if call else IDLE_TIMEOUT_S
