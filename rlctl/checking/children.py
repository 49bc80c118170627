"""The child processes of a check: what runs in one, and how the parent starts and watches them, two at a time.

If one dies or hangs, that is a failure, and its other experiments run in a new process, to judge most rules even then.
"""

import dataclasses
import functools
import os
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from gymnasium import spaces

from rlctl.checking.experiment import HASH_SEEDS, Experiment
from rlctl.checking.instance import Budget, Context, EnvironmentRaised, describe_failure, raised_by_environment
from rlctl.checking.progress import CallProgress, Position, read_clock, read_clock_of
from rlctl.checking.records import Built, CallFailure, ChildMessage, End, Finished, Mistake, Skipped
from rlctl.checking.rule import NotApplicable, NotJudged, RuleFinding
from rlctl.checking.rules import EXPERIMENTS
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.printed_lines import LineReader, clean
from rlctl.processes.child_process import ChildEndedError, ChildProcess, Standstill, anonymous_file
from rlctl.processes.messages import send


def main(
    connection: Connection,
    process: str,
    spec: EnvSpec,
    experiments: list[str],
    seconds: float,
    most_growth: float,
    memory: int,
) -> None:
    """Run some experiments of one process and send what they yield. `memory`: the descriptor of the progress."""
    send_all(connection, run(process, spec, experiments, seconds, CallProgress(memory), most_growth))


def send_all(connection: Connection, messages: Iterator[ChildMessage]) -> None:
    """Send what a child process yields, and that this was all."""
    for message in messages:
        send(connection, message)
    send(connection, End())


def run(
    process: str,
    spec: EnvSpec,
    experiments: Sequence[str],
    seconds: float,
    progress: CallProgress | None = None,
    most_growth: float = 1.0,
    known: Mapping[str, Experiment] = EXPERIMENTS,
) -> Iterator[ChildMessage]:
    """Yield the messages of some experiments of one process, which may take so many seconds together.

    A slow environment may take up to `most_growth` times as long. `known` has the experiments by name.
    """
    context = Context(spec, progress)
    context.seconds, context.most_growth = seconds, most_growth
    try:
        for message in _run_all(context, [known[name] for name in experiments], seconds):
            yield dataclasses.replace(message, process=process) if isinstance(message, CallFailure) else message
    except UsageError as error:
        yield Mistake(str(error))


def _run_all(context: Context, chosen: Sequence[Experiment], seconds: float) -> Iterator[ChildMessage]:
    began = read_clock()
    shares = sum(experiment.share for experiment in chosen)
    for experiment in chosen:
        started, growth = read_clock(), context.growth
        end = began + seconds * growth
        if experiment.name == "build":
            yield from _run(experiment, context)
            if not context.is_built:
                return
            began += read_clock() - started  # importing and building comes on top
        elif context.is_built and not isinstance(context.instance.env.action_space, spaces.Space):
            yield Skipped(experiment.name, "its action space is not a space of Gymnasium")
        elif started > end:
            spent = f"earlier experiments used all of the {seconds * growth:.3g} s of computing time"
            yield Skipped(experiment.name, spent)
            yield Finished(experiment.name, 0.0, is_complete=False, is_cut=True, needed_s=context.needed_s)
        else:
            own_end = started + (end - started) * experiment.share / shares
            further = functools.partial(_grow_further, context, growth)
            context.budget = Budget(own_end, last=end, began=started, growth=further)
            yield from _run(experiment, context)
        shares -= experiment.share
    if context.is_built:
        context.progress.phase("close")
        yield from context.instance.close()


def _grow_further(context: Context, known: float) -> float:
    """Return how much the time of an experiment has grown beyond what was known at its beginning."""
    return context.growth / known


def _run(experiment: Experiment, context: Context) -> Iterator[ChildMessage]:
    started = time.monotonic()
    context.progress.phase(experiment.name)
    is_complete, crash = True, ""
    with_finding: set[str] = set()
    try:
        for message in experiment.run(context):
            if isinstance(message, RuleFinding):
                with_finding.add(message.rule)
            yield message
    except (NotJudged, NotApplicable, RecursionError) as reason:  # of the environment's calls it is `EnvironmentRaised`
        why = TOO_DEEP if isinstance(reason, RecursionError) else str(reason)
        for name in (*experiment.rules, experiment.name):
            if name not in with_finding:
                yield Skipped(name, why, applies=not isinstance(reason, NotApplicable))
    except EnvironmentRaised as error:
        is_complete = False
        yield describe_failure(error, context.progress)
    except UsageError:
        raise
    except Exception as error:  # what calls of the environment raise was caught at the call
        is_complete = False
        if raised_by_environment(error):
            yield describe_failure(EnvironmentRaised("reading an attribute", error), context.progress)
        else:
            crash = traceback.format_exc()
    seconds, is_cut = time.monotonic() - started, context.budget.was_cut
    yield Finished(experiment.name, seconds, is_complete, is_cut, crash, needed_s=context.needed_s)


BUILD_TIMEOUT_S = 60.0  # How long importing and building may take, unless a step may take longer
FIRST_CALLS = 3.0  # So many times longer than others the first reset or step may take: it may compile or load
TOO_DEEP = "an expression of its source is nested too deeply to be read"
IDLE_TIMEOUT_S = 300.0  # outside of the environment: loading libraries [s]


@dataclasses.dataclass(frozen=True)
class ChildMain:
    """The function that runs in the child processes; it takes the arguments of `main`, and `options`."""

    function: str = "rlctl.checking.children:main"
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
        arguments = {"process": name, "spec": spec, "experiments": self.experiments}
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
