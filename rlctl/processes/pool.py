"""A pool of worker processes, which answer each message once."""

import dataclasses
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from rlctl.printed_lines import LineReader, PrintedLines, current
from rlctl.processes import messages
from rlctl.processes.child_process import ChildEndedError, ChildProcess, Standstill

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
    kind: str = ""  # name of its class, if it is one of `rlctl.errors`
    details: str | None = None  # the traceback of somebody else's code
    where: tuple[int, int, int] | None = None  # environment, episode seed and step, where it was raised in an episode


class ProcessPool:
    """One process per set of arguments, which runs `main`. Raises `OSError` if a process cannot be started.

    `printed` takes their lines, in a thread. `read_progress` returns a value that changes whenever an environment
    begins or ends a call. All processes inherit the descriptors `pass_fds`.
    """

    def __init__(
        self,
        main: str,
        arguments: Iterable[Mapping[str, Any]],
        printed: PrintedLines | None = None,
        read_progress: Callable[[], bytes] = bytes,
        pass_fds: Sequence[int] = (),
    ) -> None:
        self._read_progress = read_progress
        self.waiting_for: set[int] = set()  # the workers that have not answered yet
        self._processes: list[ChildProcess] = []
        shared = printed or current()
        self._printed, self._shares_printed = shared or PrintedLines(), shared is not None
        self._readers: list[LineReader] = []
        try:
            for job in arguments:
                self._start(main, job, pass_fds)
        except BaseException:
            self.close(grace_s=0.0)
            raise

    def _start(self, main: str, job: Mapping[str, Any], pass_fds: Sequence[int]) -> None:
        reader = self._printed.open_reader()  # one per process, so that no line cuts that of another process
        self._readers.append(reader)
        pipe = reader.descriptor
        try:
            self._processes.append(ChildProcess(main, job, stdout=pipe, stderr=pipe, pass_fds=pass_fds))
        finally:
            reader.close_descriptor()

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
        watch: Callable[[], None] | None = None,
    ) -> dict[int, Any]:
        """Wait for the answers of all asked workers, or of the `first` ones; return them by worker.

        A `WorkerException` is returned at once. `watch` is called several times a second; an exception from it ends the
        wait. Raises `WorkerFault`, which mentions `doing`, if a worker dies or makes no progress for `timeout_s`.
        """
        answers: dict[int, Any] = {}
        standstill = Standstill(self._read_progress)
        left: float | None = timeout_s
        while self.waiting_for and not (first and answers):
            if watch is not None:
                watch()
                left = _CHECK_EVERY_S if left is None else min(left, _CHECK_EVERY_S)
            connections = {self._processes[worker].connection: worker for worker in self.waiting_for}
            ready = wait(list(connections), timeout=left)
            for connection in ready:
                worker = connections[connection]  # type: ignore[index]
                answers[worker] = self._receive(worker, doing)
                if isinstance(answers[worker], WorkerException):
                    return answers
            if timeout_s is not None:
                # A worker answers once for many steps: it hangs only if there is no progress for so long.
                left = timeout_s - standstill.seconds()
                if not ready and left <= 0:
                    message = f"no answer for {timeout_s:g} s while {doing}; if that may take so long, "
                    raise WorkerFault(min(self.waiting_for), f"{message}raise --env-timeout")
                left = max(0.0, left)
        return answers

    def ask_each(self, questions: Sequence[Any], doing: str) -> list[Any]:
        """Send each question to the next free worker; return all answers, or only the first `WorkerException`."""
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
        self._read_progress = bytes  # drops the reference to its owner, and so the owner's shared memory
        for reader in self._readers:
            reader.wait()
        self._readers = []
        self._printed.report_left_out()
        if not self._shares_printed:
            self._printed.end()


def _make_fault(worker: int, error: ChildEndedError, doing: str) -> WorkerFault:
    hint = ": the system does that when memory runs out; fewer environments (--n-envs) need less"
    return WorkerFault(worker, f"worker {worker} {error} while {doing}{hint if 'SIGKILL' in str(error) else ''}")


def answer_messages(
    connection: Connection, answer: Callable[[Any], Any], describe: Callable[[BaseException], WorkerException]
) -> None:
    """In a worker: answer messages until the connection closes; if `answer` raises, send the result of `describe`."""
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
    except OSError:  # the main process, or an environment, has closed the connection
        sys.exit(1)
