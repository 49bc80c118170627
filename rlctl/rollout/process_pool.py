"""Worker processes that are sent messages and answer each once: started, waited for, watched and ended."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable
from multiprocessing.connection import wait
from typing import Any

from rlctl.processes.child_process import MAX_LINE_BYTES, ChildProcess, LineFilter, LineReader
from rlctl.rollout import messages
from rlctl.rollout.messages import Answer, Job, Message

_CHECK_EVERY_S = 0.2


class WorkerFault(Exception):
    """A worker died or does not answer."""

    def __init__(self, worker: int, message: str) -> None:
        super().__init__(message)
        self.worker = worker


class ProcessPool:
    """A process per job. Raises `OSError` if one cannot be started.

    What they print goes to `on_output`, line by line, from a thread. `progress` returns what changes whenever an
    environment begins or ends a call.
    """

    def __init__(self, jobs: Iterable[Job], on_output: Callable[[str], None], progress: Callable[[], bytes]) -> None:
        self._progress = progress
        self.waiting_for: set[int] = set()
        """The workers that have not answered yet."""
        self._processes: list[ChildProcess] = []
        self._printed = LineFilter(on_output)
        self._output = LineReader(self._printed.line, MAX_LINE_BYTES)
        try:
            for job in jobs:
                printing, passed = self._output.descriptor, (job.memory, job.numbers)
                options: dict[str, Any] = {"stdout": printing, "stderr": printing, "pass_fds": passed}
                self._processes.append(
                    ChildProcess("rlctl.rollout.worker:main", {"job": dataclasses.asdict(job)}, **options)
                )
        except BaseException:
            self.close(grace_s=0.0)
            raise
        finally:
            self._output.close_descriptor()

    def send(self, worker: int, message: Message) -> None:
        """Send a message."""
        try:
            self._processes[worker].connection.send_bytes(messages.encode(message))
        except OSError:
            raise WorkerFault(worker, self._describe_death(worker, "idle")) from None
        self.waiting_for.add(worker)

    def wait(
        self, doing: str, timeout_s: float, *, first: bool = False, check: Callable[[], None] | None = None
    ) -> dict[int, Answer]:
        """Wait for the answer of every worker that was asked, or of the `first` ones; a failure is returned at once.

        `check` is called several times a second, and may raise to leave. Raises `WorkerFault`, which says what workers
        were `doing`, if one dies, or if nothing has changed for `timeout_s`.
        """
        answers: dict[int, Answer] = {}
        deadline = time.monotonic() + timeout_s
        progress = self._progress()
        while self.waiting_for and not (first and answers):
            left = max(0.0, deadline - time.monotonic())
            if check is not None:
                check()
                left = min(left, _CHECK_EVERY_S)
            connections = {self._processes[worker].connection: worker for worker in self.waiting_for}
            ready = wait(list(connections), timeout=left)
            if not ready and time.monotonic() >= deadline:
                # A worker answers once for many steps: only one that stands still for so long hangs.
                if progress == (progress := self._progress()):
                    message = f"no answer for {timeout_s:g} s while {doing}; if that may take so long, "
                    raise WorkerFault(min(self.waiting_for), f"{message}raise --env-timeout")
                deadline = time.monotonic() + timeout_s
            for connection in ready:
                worker = connections[connection]  # type: ignore[index]
                answers[worker] = self._receive(worker, doing)
                if answers[worker].failure is not None:
                    return answers
        return answers

    def _receive(self, worker: int, doing: str) -> Answer:
        try:
            content = self._processes[worker].connection.recv_bytes()
        except (EOFError, OSError):
            raise WorkerFault(worker, self._describe_death(worker, doing)) from None
        self.waiting_for.discard(worker)
        answer: Answer = messages.decode(content)
        return answer

    def _describe_death(self, worker: int, doing: str) -> str:
        how = self._processes[worker].describe_end()
        hint = ": the system does that when memory runs out; fewer environments (--n-envs) need less"
        return f"worker {worker} {how} while {doing}{hint if 'SIGKILL' in how else ''}"

    def close(self, grace_s: float) -> None:
        """End the processes; those that do not end within `grace_s` are killed. A second call does nothing."""
        for process in self._processes:
            process.connection.close()
        deadline = time.monotonic() + grace_s
        for process in self._processes:
            process.close(max(0.0, deadline - time.monotonic()))
        self._processes = []
        self.waiting_for = set()
        self._progress = bytes  # or it would hold its owner, and the memory that this maps
        self._output.wait()
        self._printed.end()
