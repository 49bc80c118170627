"""Plays the cells of a robustness map on Ray: each actor plays one cell after another.

An actor receives the policy's bytes and needs no shared folder. A lost actor is replaced, and its cell is played again.
"""

import contextlib
import os
import tempfile
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.cluster.ray_trainings import Pulse, connect, describe_slots, is_copied
from rlctl.cluster.work import ClusterSettings, compare_versions, describe_driver
from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.players import LoadedPolicy, load_player
from rlctl.evaluation.vary import CellPlayer, Scores, order_cells

_POLL_S = 5.0


class CellActor:
    """On a node: a policy and environments that play one cell after another."""

    def start(self, spec: EnvSpec, request: EvalRequest, name: str, policy: bytes, driver: dict[str, Any]) -> list[str]:
        """Compare this machine with the driver and start the environments; return warnings."""
        if driver["cwd"] is not None:
            with contextlib.suppress(OSError):  # an installed task needs no folder
                os.chdir(driver["cwd"])
        warnings = compare_versions(spec.task, driver["versions"], driver["source_sha256"])
        os.environ["RLCTL_CORES"] = str(driver["cpus"])
        self._folder = tempfile.TemporaryDirectory(prefix="rlctl-")  # removed when the actor ends
        file = Path(self._folder.name) / name
        file.write_bytes(policy)
        player = load_player(file, request.deterministic)
        self._player = CellPlayer(spec, player, request)
        return warnings

    def play(self, spec: EnvSpec) -> Scores:
        """Play all episodes in one setting."""
        return self._player.measure(spec)


class RayCells:
    """Plays cells on Ray, as many at a time as its cores allow."""

    def __init__(self, address: str, settings: ClusterSettings, policy: LoadedPolicy, request: EvalRequest) -> None:
        self._address, self._settings, self._policy, self._request = address, settings, policy, request
        self._idle: list[Any] = []
        self._calls: dict[Any, tuple[Any, int | None]] = {}  # per call its actor and its cell, None for the start
        self._lost: Counter[int | None] = Counter()

    def play(self, specs: Sequence[EnvSpec]) -> Iterator[tuple[int, Scores]]:
        """Yield the index and the scores of each setting.

        Raises the errors of rlctl that occur on a node, and `TaskError` for a cell whose actor is lost too often.
        """
        self._ray = connect(self._address, specs[0].task, self._settings.cpus)
        self._pulse = Pulse(self._ray)
        where, slots = describe_slots(self._ray, self._settings.cpus, len(specs))
        output.print_notes([f"{output.format_count(len(specs), 'cell')}, {where}"])
        for _ in range(max(1, slots)):
            self._add(specs[0])
        waiting, warnings = deque(order_cells(specs)), set[str]()
        while waiting or any(index is not None for _, index in self._calls.values()):
            while waiting and self._idle:
                actor, cell = self._idle.pop(), waiting.popleft()
                self._calls[actor.play.remote(specs[cell])] = actor, cell
            index, answer = self._wait()
            if isinstance(answer, Exception):
                self._count_loss(index, answer)
                self._add(specs[0])
                waiting.extendleft([] if index is None else [index])
            elif index is not None:
                yield index, answer
            else:
                output.print_notes([warning for warning in answer if warning not in warnings])
                warnings.update(answer)

    def _add(self, spec: EnvSpec) -> None:
        """Start an actor; it begins once the cluster has free cores."""
        driver = describe_driver(spec.task) | {"cpus": self._settings.cpus}
        driver["cwd"] = None if is_copied(spec.task) else os.getcwd()
        actor = self._ray.remote(num_cpus=self._settings.cpus)(CellActor).remote()
        file = self._policy.path
        self._calls[actor.start.remote(spec, self._request, file.name, file.read_bytes(), driver)] = actor, None

    def _wait(self) -> tuple[int | None, Any]:
        """Wait for a call to end; return the index of its cell, and its answer or the error of a lost actor."""
        while not (done := self._ray.wait(list(self._calls), timeout=_POLL_S)[0]):
            self._pulse.check()
        actor, index = self._calls.pop(done[0])
        try:
            answer = self._ray.get(done[0])
        except self._ray.exceptions.RayTaskError as error:
            raise error.cause from None
        except self._ray.exceptions.RayError as error:
            return index, error
        self._idle.append(actor)
        return index, answer

    def _count_loss(self, index: int | None, error: Exception) -> None:
        self._lost[index] += 1
        if self._lost[index] > self._settings.retries:
            reason = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
            raise TaskError(f"lost on Ray after {self._settings.retries} retries: {reason}")
        output.print_notes(["a node was lost; its cell is played again"])
