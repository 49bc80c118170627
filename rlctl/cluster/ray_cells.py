"""Cells of a robustness map on Ray: actors that stay play one cell after another.

An actor receives the policy's bytes and needs no shared folder. Ray retries nothing here: a lost actor is replaced, and
its cell is played again.
"""

import contextlib
import dataclasses
import os
import tempfile
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.cluster.ray_connection import Pulse, connect, describe_slots, is_copied
from rlctl.cluster.settings import ClusterSettings
from rlctl.cluster.work import compare_versions
from rlctl.environments.spec import EnvSpec
from rlctl.environments.task_version import identify_task
from rlctl.errors import TaskError
from rlctl.evaluation.episode_statistics import summarize
from rlctl.evaluation.evaluate import start_workers
from rlctl.evaluation.players import LoadedPolicy, load_player
from rlctl.evaluation.request import EvalRequest
from rlctl.evaluation.vary import CellPlayer, order_cells
from rlctl.run.robustness import Outcome
from rlctl.version import collect_versions

_CLOSE_S = 5.0
_POLL_S = 5.0


@dataclasses.dataclass(frozen=True)
class CellWork:
    """What an actor needs to know to play cells."""

    policy: bytes  # a policy file
    suffix: str  # that of the policy file
    spec: EnvSpec  # the nominal environment
    request: EvalRequest
    cwd: str | None  # the driver's current folder; None if nodes have a copy, in which they start
    cpus: int
    versions: dict[str, str]
    source_sha256: str | None  # hash of the task's file on the driver


class CellActor:
    """On a node: a policy and environments that play one cell after another."""

    def start(self, work: CellWork) -> list[str]:
        """Check this machine's versions and start the environments; return warnings."""
        if work.cwd is not None:
            with contextlib.suppress(OSError):  # an installed task needs no folder
                os.chdir(work.cwd)
        warnings = compare_versions(work.spec.task, work.versions, work.source_sha256)
        os.environ["RLCTL_CORES"] = str(work.cpus)
        self._folder = tempfile.TemporaryDirectory(prefix="rlctl-")
        file = Path(self._folder.name) / f"policy{work.suffix}"
        file.write_bytes(work.policy)
        policy = load_player(file, work.request.deterministic)
        self._workers = start_workers(work.spec, work.request)
        policy.give_to(self._workers)
        self._player = CellPlayer(self._workers, policy, work.request)
        return warnings

    def play(self, spec: EnvSpec) -> Outcome:
        """Play all episodes in one setting."""
        return summarize(self._player.play(spec))

    def close(self) -> None:
        """End the environments and remove the policy's copy."""
        self._workers.close()
        self._folder.cleanup()


class RayCells:
    """Plays cells on Ray, as many at a time as its cores allow; it is a `PlayCells`."""

    def __init__(self, address: str, settings: ClusterSettings) -> None:
        self._address, self._settings = address, settings

    def __call__(
        self, policy: LoadedPolicy, request: EvalRequest, specs: Sequence[EnvSpec]
    ) -> Iterator[tuple[int, Outcome]]:
        """Yield the index and the scores of each setting.

        Raises the errors of rlctl that occur on a node, and `TaskError` for a cell whose actor is lost too often.
        """
        ray = connect(self._address, specs[0].task, self._settings.cpus)
        where, slots = describe_slots(ray, self._settings.cpus, len(specs))
        output.print_notes([f"{output.format_count(len(specs), 'cell')}, {where}"])
        actors = _Actors(ray, self._make_work(policy, request, specs[0]), self._settings)
        try:
            for _ in range(max(1, slots)):
                actors.add()
            yield from actors.play(specs)
        finally:
            actors.close()

    def _make_work(self, policy: LoadedPolicy, request: EvalRequest, spec: EnvSpec) -> CellWork:
        return CellWork(
            policy=policy.path.read_bytes(),
            suffix=policy.path.suffix,
            spec=spec,
            request=request,
            cwd=None if is_copied(spec.task) else os.getcwd(),
            cpus=self._settings.cpus,
            versions=collect_versions(),
            source_sha256=identify_task(spec.task)["source_sha256"],
        )


class _Actors:
    """The actors of a map. A lost one is replaced, which takes effect once the cluster has a free place."""

    def __init__(self, ray: Any, work: CellWork, settings: ClusterSettings) -> None:
        self._ray, self._work, self._retries = ray, ray.put(work), settings.retries
        self._class = ray.remote(num_cpus=settings.cpus)(CellActor)
        self._all: list[Any] = []
        self._idle: list[Any] = []
        self._calls: dict[Any, tuple[Any, int | None]] = {}
        """Per call in progress its actor and the index of its cell, None for the start."""
        self._pulse = Pulse(ray)
        self._lost: Counter[int | None] = Counter()

    def add(self) -> None:
        """Start an actor."""
        self._all.append(actor := self._class.remote())
        self._calls[actor.start.remote(self._work)] = actor, None

    def play(self, specs: Sequence[EnvSpec]) -> Iterator[tuple[int, Outcome]]:
        """Yield the index and the scores of each setting."""
        waiting = deque(order_cells(specs))
        warnings: set[str] = set()
        while waiting or any(index is not None for _, index in self._calls.values()):
            while waiting and self._idle:
                actor, cell = self._idle.pop(), waiting.popleft()
                self._calls[actor.play.remote(specs[cell])] = actor, cell
            index, answer = self._wait()
            if isinstance(answer, Exception):
                self._replace(index, answer)
                waiting.extendleft([] if index is None else [index])
            elif index is not None:
                yield index, answer
            else:
                output.print_notes([warning for warning in answer if warning not in warnings])
                warnings.update(answer)

    def _wait(self) -> tuple[int | None, Any]:
        """Wait for a call to end; return the index of its cell, and its answer or the error of a lost actor."""
        exceptions = self._ray.exceptions
        while not (done := self._ray.wait(list(self._calls), timeout=_POLL_S)[0]):
            self._pulse.check()
        reference = done[0]
        actor, index = self._calls.pop(reference)
        try:
            answer = self._ray.get(reference)
        except exceptions.RayTaskError as error:
            raise error.cause from None
        except exceptions.RayError as error:
            return index, error
        self._idle.append(actor)
        return index, answer

    def _replace(self, index: int | None, error: Exception) -> None:
        self._lost[index] += 1
        reason = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
        if self._lost[index] > self._retries:
            raise TaskError(f"lost on Ray after {self._retries} retries: {reason}")
        output.print_notes(["a node was lost; its cell is played again"])
        self.add()

    def close(self) -> None:
        """End all actors."""
        if self._idle:
            self._ray.wait(
                [actor.close.remote() for actor in self._idle], num_returns=len(self._idle), timeout=_CLOSE_S
            )
        for actor in self._all:
            self._ray.kill(actor)
