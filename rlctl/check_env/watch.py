"""Starts the child processes, two at a time, and passes on what they say; deaths and hangs become messages too."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection, wait

from rlctl.check_env import studies
from rlctl.check_env.children import Child
from rlctl.check_env.progress import Where
from rlctl.check_env.wire import Message, decode, skip
from rlctl.env_spec import EnvSpec

AT_ONCE = 2
"""The libraries' checkers bring torch, with as much memory as everything else: they wait for a place."""
TOTAL_S = 26.0
"""What is left of this is for the libraries' checkers, the last to start [s]."""
LEAST_CHECKERS_S = 8.0
"""They get this much in any case: loading torch is part of it [s]."""
_POLL_S = 0.1


class Watch:
    """The child processes of one check."""

    def __init__(
        self, spec: EnvSpec, budget_s: float, env_timeout_s: float, receive: Callable[[Message], None]
    ) -> None:
        self._spec = spec
        self._budget_s = budget_s
        self._env_timeout_s = env_timeout_s
        self._receive = receive
        self._started = time.monotonic()
        self._waiting: dict[str, list[str]] = {}
        self._active: dict[Connection, Child] = {}
        self.children: list[Child] = []
        """Those that were started, the probe first."""

    def run(self, parts: Mapping[str, list[str]], on_poll: Callable[[Where], None]) -> None:
        """Start a process per part, with the names of its studies, and come back when all are done, dead or ended."""
        self._waiting = dict(parts)
        self._start()
        while self._active:
            for ready in wait(list(self._active), timeout=_POLL_S):
                self._read(self._active[ready])  # type: ignore[index]
            for child in list(self._active.values()):
                self._check(child)
            self._start()
            if self._active:
                on_poll(next(iter(self._active.values())).where)

    def close(self) -> None:
        """End what still runs."""
        for child in self.children:
            child.close()

    def _start(self) -> None:
        while self._waiting and len(self._active) < AT_ONCE:
            part = next(iter(self._waiting))
            names = self._waiting.pop(part)
            seconds = self._budget_s
            if part == "checkers":
                seconds = max(LEAST_CHECKERS_S, TOTAL_S - (time.monotonic() - self._started))
            child = Child(part, self._spec, names, seconds, hash_seed=studies.PARTS[part])
            self.children.append(child)
            self._active[child.connection] = child

    def _read(self, child: Child) -> None:
        try:
            message = decode(child.connection.recv_bytes())
        except (EOFError, OSError):
            self._receive(_failure(child, "died", child.death()))
            del self._active[child.connection]
            return
        kind = message[0]["type"]
        if kind == "done":
            child.is_done = True
            del self._active[child.connection]
            child.close()
            return
        if kind in ("usage_error", "load_error"):
            self._waiting.clear()  # what cannot be built here cannot be built there
        self._receive(message)

    def _check(self, child: Child) -> None:
        if child.is_over_time:
            for name in child.names:
                self._receive(skip(name, f"the libraries' checkers had {child.seconds:.0f} s and took longer"))
            self._end(child)
        elif told := child.hangs(self._env_timeout_s):
            self._receive(_failure(child, "hung", told))
            self._end(child)
            # The checkers would hang in the same call, for much longer.
            self._waiting.pop("checkers", None)
            for other in [each for each in self._active.values() if each.part == "checkers"]:
                self._end(other)

    def _end(self, child: Child) -> None:
        child.close()
        del self._active[child.connection]


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
