"""The child processes of a check: how the parent starts and watches them, two at a time.

If one dies or hangs, that is a failure, and its other experiments run in a new process, to judge most rules even then.
"""

import dataclasses
import functools
import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from rlctl.checking.experiment import HASH_SEEDS
from rlctl.checking.progress import CallProgress, Position, read_clock_of
from rlctl.checking.records import Built, CallFailure, ChildMessage, End, Finished
from rlctl.checking.rule_index import find_modules
from rlctl.environments.spec import EnvSpec
from rlctl.printed_lines import LineReader, clean
from rlctl.processes.child_process import ChildEndedError, ChildProcess, Standstill, anonymous_file

BUILD_TIMEOUT_S = 60.0  # How long importing and building may take, unless a step may take longer
FIRST_CALLS = 3.0  # So many times longer than others the first reset or step may take: it may compile or load
IDLE_TIMEOUT_S = 300.0  # outside of the environment: loading libraries [s]


@dataclasses.dataclass(frozen=True)
class ChildMain:
    """The function that runs in the child processes; it takes the arguments of `main`, and `options`."""

    function: str = "rlctl.checking.child:main"
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)


class Child:
    """A process of the check, watched."""

    def __init__(
        self,
        name: str,
        spec: EnvSpec,
        experiments: Sequence[str],
        seconds: float,
        most_growth: float,
        main: ChildMain,
    ) -> None:
        self.name = name
        self.experiments = list(experiments)  # Those that it has not finished; the first is running
        self.has_finished_one = False
        self.printed = 0  # Lines that were written to stdout
        self.first_line = ""
        self.last_lines: deque[str] = deque(maxlen=8)
        self._memory = anonymous_file()
        self.progress = CallProgress(self._memory)
        self._readers = LineReader(functools.partial(self._keep, counts=True)), LineReader(self._keep)
        modules = find_modules(experiments)
        arguments = {"process": name, "spec": spec, "experiments": self.experiments, "modules": modules}
        self.process = ChildProcess(
            main.function,
            {**arguments, "seconds": seconds, "most_growth": most_growth, "memory": self._memory, **main.options},
            stdout=self._readers[0].descriptor,
            stderr=self._readers[1].descriptor,
            pass_fds=[self._memory],
            env={"PYTHONHASHSEED": str(HASH_SEEDS.get(name, 0))},
        )
        for reader in self._readers:
            reader.close_descriptor()
        pid = self.process.process.pid
        self.standstill = Standstill(lambda: self.progress.read().counter, clock=lambda: read_clock_of(pid))

    def _keep(self, line: str, *, counts: bool = False) -> None:
        if line := clean(line):
            self.printed += counts
            self.first_line = self.first_line or (line if counts else "")
            self.last_lines.append(line)

    def fail(self, kind: str, error: str) -> CallFailure:
        """Return the failure that ends it, with the last lines that it has printed."""
        at, details = self.progress.read(), "\n".join(self.last_lines) or None
        call = at.call or "between calls"
        return CallFailure(kind, call, at.phase, at.episode, at.seed, at.step, error, details, process=self.name)

    def wait_for_lines(self) -> None:
        """Wait until all that an ended process has printed was read."""
        for reader in self._readers:
            reader.wait()

    def close(self, grace_s: float = 0.0) -> None:
        """End it, and what it has started."""
        self.process.close(grace_s)
        self.wait_for_lines()
        os.close(self._memory)


def _limit_s(position: Position, env_timeout_s: float) -> float:
    call = position.call
    if position.is_first and call in ("reset", "step"):
        return FIRST_CALLS * env_timeout_s
    if call in ("load", "build"):
        return max(BUILD_TIMEOUT_S, env_timeout_s)
    return env_timeout_s if call else IDLE_TIMEOUT_S


class Supervisor:
    """The child processes of one check."""

    def __init__(
        self,
        spec: EnvSpec,
        budget_s: float,
        env_timeout_s: float,
        receive: Callable[[ChildMessage], None],
        most_growth: float = 1.0,
        main: ChildMain = ChildMain(),
    ) -> None:
        self._most_growth, self._main = most_growth, main
        self._spec, self._budget_s, self._env_timeout_s, self._receive = spec, budget_s, env_timeout_s, receive
        self._waiting: dict[str, Sequence[str]] = {}
        self._active: dict[Connection, Child] = {}
        self._has_built = False
        self._started_again: set[str] = set()
        self.children: list[Child] = []  # Those that were started, the first process first

    def run(self, experiments: Mapping[str, Sequence[str]], on_poll: Callable[[str], None]) -> None:
        """Run each process with some experiments until all have ended; `on_poll` is called with their phases."""
        self._waiting = dict(experiments)
        self._start()
        try:
            while self._active:
                self._poll(on_poll)
                self._start()
        finally:
            for child in self._active.values():
                child.close()

    def _poll(self, on_poll: Callable[[str], None]) -> None:
        for ready in wait(list(self._active), timeout=0.1):
            self._read(self._active[ready])  # type: ignore[index]
        for child in list(self._active.values()):
            position = child.progress.read()
            limit_s = _limit_s(position, self._env_timeout_s)  # first: if the call ends now, nothing stands still
            on_poll(position.phase)
            if child.standstill.seconds() > limit_s:
                self._end(child, child.fail("hung", f"did not return within {limit_s:g} s"))

    def _start(self) -> None:
        while self._waiting and len(self._active) < (2 if self._has_built else 1):
            name = next(iter(self._waiting))
            experiments = self._waiting.pop(name)
            child = Child(name, self._spec, experiments, self._budget_s, self._most_growth, self._main)
            self.children.append(child)
            self._active[child.process.connection] = child

    def _read(self, child: Child) -> None:
        try:
            message = child.process.receive()
        except ChildEndedError as end:
            child.wait_for_lines()
            self._end(child, child.fail("died", str(end)))
            return
        match message:
            case End():
                self._end(child, grace_s=1.0)
                return
            case Built():
                self._has_built = True
            case Finished():
                child.experiments.remove(message.experiment)
                child.has_finished_one = True
        self._receive(message)

    def _end(self, child: Child, failure: CallFailure | None = None, grace_s: float = 0.0) -> None:
        if failure is not None:
            self._receive(failure)
            rest = child.experiments[1:]
            may_succeed = failure.kind == "died" or not child.progress.read().is_first  # a first call would hang again
            if may_succeed and rest and child.has_finished_one and child.name not in self._started_again:
                self._started_again.add(child.name)
                self._waiting = {child.name: rest, **self._waiting}
        if not self._has_built:
            self._waiting.clear()  # what cannot be built here cannot be built there
        del self._active[child.process.connection]
        child.close(grace_s)
