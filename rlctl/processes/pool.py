"""Worker processes that are sent messages and answer each once: started, waited for, watched and ended."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from rlctl.processes import messages
from rlctl.processes.child_process import ChildEndedError, ChildProcess, Standstill
from rlctl.processes.printed_lines import MAX_LINE_BYTES, LineFilter, LineReader

_CHECK_EVERY_S = 0.2


class WorkerFault(Exception):
    """A worker died or does not answer."""

    def __init__(self, worker: int, message: str) -> None:
        super().__init__(message)
        self.worker = worker


@dataclasses.dataclass(frozen=True)
class WorkerException:
    """An exception that a worker answers with."""

    message: str
    kind: str = ""
    """Name of its class, if it is one of `rlctl.errors`."""
    details: str | None = None
    """The traceback of somebody else's code."""
    where: tuple[int, int, int] | None = None
    """Environment, episode seed and step, where it was raised in an episode."""


class ProcessPool:
    """A process per set of arguments, which runs `main`. Raises `OSError` if one cannot be started.

    What they print goes to `on_output`, line by line, from a thread. `read_progress` returns what changes whenever an
    environment begins or ends a call. `pass_fds` are descriptors that all of them get.
    """

    def __init__(
        self,
        main: str,
        arguments: Iterable[Mapping[str, Any]],
        on_output: Callable[[str], None],
        read_progress: Callable[[], bytes] = bytes,
        pass_fds: Sequence[int] = (),
    ) -> None:
        self._read_progress = read_progress
        self.waiting_for: set[int] = set()
        """The workers that have not answered yet."""
        self._processes: list[ChildProcess] = []
        self._printed = LineFilter(on_output)
        self._output = LineReader(self._printed.line, MAX_LINE_BYTES)
        output = self._output.descriptor
        try:
            for given in arguments:
                self._processes.append(ChildProcess(main, given, stdout=output, stderr=output, pass_fds=pass_fds))
        except BaseException:
            self.close(grace_s=0.0)
            raise
        finally:
            self._output.close_descriptor()

    def send(self, worker: int, message: Any) -> None:
        """Send a message."""
        try:
            self._processes[worker].send(message)
        except ChildEndedError as error:
            raise _make_fault(worker, error, "idle") from None
        self.waiting_for.add(worker)

    def wait(
        self,
        doing: str,
        timeout_s: float | None = None,
        *,
        first: bool = False,
        check: Callable[[], None] | None = None,
    ) -> dict[int, Any]:
        """Wait for the answer of every worker that was asked, or of the `first` ones; return the answers by worker.

        A `WorkerException` is returned at once. `check` is called several times a second, and may raise to leave.
        Raises `WorkerFault`, which says what workers were `doing`, if one dies, or if nothing has changed for
        `timeout_s`.
        """
        answers: dict[int, Any] = {}
        standstill = Standstill(self._read_progress)
        left: float | None = timeout_s
        while self.waiting_for and not (first and answers):
            if check is not None:
                check()
                left = _CHECK_EVERY_S if left is None else min(left, _CHECK_EVERY_S)
            connections = {self._processes[worker].connection: worker for worker in self.waiting_for}
            ready = wait(list(connections), timeout=left)
            for connection in ready:
                worker = connections[connection]  # type: ignore[index]
                answers[worker] = self._receive(worker, doing)
                if isinstance(answers[worker], WorkerException):
                    return answers
            if timeout_s is not None:
                # A worker answers once for many steps: only one that stands still for so long hangs.
                left = timeout_s - standstill.seconds()
                if not ready and left <= 0:
                    message = f"no answer for {timeout_s:g} s while {doing}; if that may take so long, "
                    raise WorkerFault(min(self.waiting_for), f"{message}raise --env-timeout")
                left = max(0.0, left)
        return answers

    def ask_each(self, questions: Sequence[Any], doing: str) -> list[Any]:
        """Return the answers to questions, each given to the next worker that is free.

        It leaves at the first `WorkerException`, which is then the last of the answers.
        """
        waiting, asked = deque(enumerate(questions)), dict[int, int]()
        answers: dict[int, Any] = {}
        free = list(range(len(self._processes)))
        while waiting or asked:
            while waiting and free:
                worker = free.pop()
                asked[worker], question = waiting.popleft()
                self.send(worker, question)
            for worker, answer in self.wait(doing, first=True).items():
                answers[asked.pop(worker)] = answer
                free.append(worker)
                if isinstance(answer, WorkerException):
                    return [answer]
        return [answers[index] for index in range(len(questions))]

    def _receive(self, worker: int, doing: str) -> Any:
        try:
            answer = self._processes[worker].receive()
        except ChildEndedError as error:
            raise _make_fault(worker, error, doing) from None
        self.waiting_for.discard(worker)
        return answer

    def close(self, grace_s: float) -> None:
        """End the processes; those that do not end within `grace_s` are killed. A second call does nothing."""
        for process in self._processes:
            process.connection.close()
        deadline = time.monotonic() + grace_s
        for process in self._processes:
            process.close(max(0.0, deadline - time.monotonic()))
        self._processes = []
        self.waiting_for = set()
        self._read_progress = bytes  # or it would hold its owner, and the memory that this maps
        self._output.wait()
        self._printed.end()


def _make_fault(worker: int, error: ChildEndedError, doing: str) -> WorkerFault:
    hint = ": the system does that when memory runs out; fewer environments (--n-envs) need less"
    return WorkerFault(worker, f"worker {worker} {error} while {doing}{hint if 'SIGKILL' in str(error) else ''}")


def answer_messages(
    connection: Connection, answer: Callable[[Any], Any], describe: Callable[[BaseException], WorkerException]
) -> None:
    """In a worker: answer messages until the connection closes, with `describe`'s result where `answer` raises."""
    try:
        while True:
            try:
                message = messages.receive(connection)
            except (EOFError, ConnectionResetError):
                return
            try:
                content = messages.encode(answer(message))
            except BaseException as error:
                content = messages.encode(describe(error))
            connection.send_bytes(content)
    except OSError:  # the main process needs no more answers, or an environment has closed the connection
        sys.exit(1)
