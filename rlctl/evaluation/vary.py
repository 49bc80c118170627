"""`rlctl eval --vary` and `--push`: how robust a policy is, with the same episodes in every cell."""

import contextlib
import dataclasses
import functools
import itertools
import json
import math
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.engine import MUJOCO, Engine
from rlctl.environments.registry import is_task
from rlctl.environments.spec import EnvChanges, EnvSpec
from rlctl.errors import AnswerIsNo, ArtifactError, TaskError, UsageError
from rlctl.evaluation import robustness
from rlctl.evaluation.episode_statistics import summarize
from rlctl.evaluation.eval_request import NO_GATES, EvalRequest, Gates
from rlctl.evaluation.evaluate import choose_baseline_task, start_workers
from rlctl.evaluation.players import Baseline, LoadedPolicy, find_player, load_baseline
from rlctl.evaluation.push import measure_push
from rlctl.evaluation.robustness import Axis, Cell, FailedCell, Failure, Outcome, Robustness, RobustnessMap
from rlctl.play.collect import play_episodes
from rlctl.play.messages import EpisodeResult
from rlctl.play.seeds import Stream, episode_seeds
from rlctl.play.workers import Workers
from rlctl.policy.actor import Exploration
from rlctl.runs.directory import RunDirectory
from rlctl.storage import files
from rlctl.version import collect_versions

ASK_ABOVE_S = 600.0  # rlctl asks before it starts a measurement that takes longer than this [s]
Scores = Outcome | Failure
PlayCells = Callable[[LoadedPolicy, EvalRequest, Sequence[EnvSpec]], Iterator[tuple[int, Scores]]]
"""Plays the episodes of a request in each setting; yields the index and the scores of each, in any order."""


def measure_robustness(
    request: EvalRequest,
    vary: Sequence[str] = (),
    *,
    push: bool = False,
    yes: bool = False,
    gates: Gates = NO_GATES,
    play_cells: PlayCells | None = None,
) -> Robustness:
    """Measure a policy in every cell of the maps of `vary`, and with pushes, and store the result in its run.

    `vary` is `NAME=LOWEST:HIGHEST:VALUES`, one or two, or `all`; see `robustness.read_axes`. `yes` starts a long
    measurement without asking; so does `play_cells`, which plays the cells elsewhere. Domain randomization is off,
    unless the request's own changes turn it on.
    """
    if request.changes.randomize is None:
        request = dataclasses.replace(request, changes=dataclasses.replace(request.changes, randomize=False))
    policy: LoadedPolicy | Baseline
    run: RunDirectory | None = None
    if request.baseline is not None:
        policy, spec = load_baseline(request.baseline), choose_baseline_task(request)
    else:
        source, policy, spec = find_player(request)
        run = source.run
    maps = robustness.read_axes(vary, spec) if vary else []
    if any(axis.setting == robustness.SIM for axes in maps for axis in axes):
        dataclasses.replace(spec, sim=MUJOCO).make().close()  # raises for what MuJoCo cannot build
    cells = sum(math.prod(len(axis.values) for axis in axes) for axes in maps)
    gates.check_reachable(request.episodes)
    with CellPlayer(spec, policy, request) as player:
        start = time.monotonic()
        with output.show_progress("with nothing varied", request.episodes, "episodes") as show:
            episodes = player.play(
                spec, watch=show, check=lambda result: gates.check_possible(result.success is not None)
            )
        nominal = summarize(episodes)
        if play_cells is None:
            _ask(cells, time.monotonic() - start, yes)
        play = player.play_cells
        if play_cells is not None:
            if policy.info is None:
                raise UsageError(f"--on: nodes play policy files only; leave it out, or --policy {request.baseline}")
            play = functools.partial(play_cells, policy, request)
        measured = _play_maps(maps, spec, play) if maps else []
        pushed = measure_push(spec, episodes, player.play_pushed) if push else None
    result = Robustness(
        task=spec.task,
        parameters=dict(spec.parameters),
        reward_weights=dict(spec.reward_weights),
        events={name: dict(event) for name, event in spec.events.items()},
        randomize=spec.randomize,
        own_settings=_find_own_settings(spec, policy, request),
        sim=_find_other_engine(spec, policy, request),
        other_task=request.task,
        policy_file=policy.name,
        is_baseline=policy.info is None,
        algo="" if policy.info is None else policy.info.algo,
        training_steps=0 if policy.info is None else policy.info.training_steps,
        episodes=request.episodes,
        seed=request.seed,
        deterministic=request.deterministic,
        nominal=nominal,
        maps=measured,
        push=pushed,
        command=shlex.join(["rlctl", *sys.argv[1:]]),
        versions=collect_versions(),
    )
    if run is not None and policy.info is not None and request.task in (None, policy.info.spec.task):
        _store(run.robustness_file, result)
    return result


def _find_other_engine(spec: EnvSpec, policy: LoadedPolicy | Baseline, request: EvalRequest) -> Engine:
    """Return the engine of a measurement; no choice where it is the policy's own, or that of the task's recipe."""
    if policy.info is None:
        return request.changes.sim
    own = policy.info.spec.replace_missing_engine()
    return Engine() if spec.sim == own.sim else spec.sim


class CellPlayer(contextlib.AbstractContextManager["CellPlayer"]):
    """Plays the same episodes in one setting after another, with the same workers."""

    def __init__(self, spec: EnvSpec, policy: LoadedPolicy | Baseline, request: EvalRequest) -> None:
        self._spec, self._policy, self._request = spec, policy, request
        self._seeds = episode_seeds(request.seed, Stream.EVAL, request.episodes)
        self._exploration = Exploration(stochastic=not request.deterministic)
        self._has_events = is_task(spec.constructor())
        self.workers = self._start_workers()

    def _start_workers(self) -> Workers:
        workers = start_workers(self._spec, self._request)
        try:
            self._policy.give_to(workers)
        except BaseException:
            workers.close()
            raise
        return workers

    def __exit__(self, *_: object) -> None:
        self.workers.close()

    def play_pushed(self, push: dict[str, object]) -> list[EpisodeResult]:
        """Play all episodes with a push, and show the progress."""
        with output.show_progress("with a push", self._request.episodes, "episodes") as show:
            return self.play(self._spec, push, watch=show)

    def play(
        self,
        spec: EnvSpec,
        push: dict[str, object] | None = None,
        *,
        watch: Callable[[int], None] = lambda done: None,
        check: Callable[[EpisodeResult], None] = lambda result: None,
    ) -> list[EpisodeResult]:
        """Play all episodes with the events and parameters of `spec`; `push` is as in `Workers.set_events`.

        `watch` and `check` are as in `play_episodes`.
        """
        workers = self.workers
        if (spec.parameters, spec.sim) != (workers.spec.parameters, workers.spec.sim):
            workers.rebuild(spec)
            self._policy.give_to(workers)
        if self._has_events:
            workers.set_events(spec, push)
        episodes = play_episodes(workers, self._seeds, self._exploration, watch=watch, check=check)
        return [episode.result for episode in episodes]

    def play_cells(self, specs: Sequence[EnvSpec]) -> Iterator[tuple[int, Scores]]:
        """Play all episodes in each setting; yield its index and scores."""
        for index in order_cells(specs):
            yield index, self.measure(specs[index])

    def measure(self, spec: EnvSpec) -> Scores:
        """Play all episodes in one setting; an error of the environment is the result there, and ends nothing else."""
        try:
            return summarize(self.play(spec))
        except TaskError as error:
            self.workers.close(grace_s=0.0)
            self.workers = self._start_workers()
            return Failure(failure=str(error).partition("\n")[0])


def order_cells(specs: Sequence[EnvSpec]) -> list[int]:
    """Return the indices of settings, those with equal task parameters and engines next to each other.

    Others need a new world.
    """

    def world(index: int) -> tuple[list[Any], str]:
        return sorted(specs[index].parameters.items(), key=repr), str(specs[index].sim)

    return sorted(range(len(specs)), key=world)


def _play_maps(
    maps: Sequence[list[Axis]], spec: EnvSpec, play: Callable[[Sequence[EnvSpec]], Iterator[tuple[int, Scores]]]
) -> list[RobustnessMap]:
    points = [(axes, values) for axes in maps for values in itertools.product(*(axis.values for axis in axes))]
    cells: dict[int, Cell | FailedCell] = {}
    with output.show_progress("varying", len(points), "cells") as show:
        for index, outcome in play([robustness.apply_axes(axes, values, spec) for axes, values in points]):
            pairs = list(zip(*points[index], strict=True))
            nominal = all(axis.nominal is not None and abs(axis.nominal - value) < 1e-9 for axis, value in pairs)
            kind = FailedCell if isinstance(outcome, Failure) else Cell
            cells[index] = kind(**outcome.model_dump(), values=[value for _, value in pairs], nominal=nominal)
            show(len(cells))
    failures = [cell.failure for cell in cells.values() if isinstance(cell, FailedCell)]
    if len(failures) == len(points):
        raise TaskError(f"{failures[0]}\nso it is in every cell of --vary; nothing is stored")
    return [
        RobustnessMap(axes=axes, cells=[cells[index] for index in range(len(points)) if points[index][0] is axes])
        for axes in maps
    ]


def _ask(cells: int, seconds: float, yes: bool) -> None:
    total = cells * seconds
    if yes or total <= ASK_ABOVE_S:
        return
    expected = f"{cells:,} cells will take about {output.format_duration(total)}: the nominal one took {seconds:.1f} s"
    refusal = f"--vary: {expected}; use fewer values or --episodes, or start anyway with --yes"
    if not output.confirm(f"{expected}; start?", refusal):
        raise UsageError("--vary: not started")


def _store(file: Path, result: Robustness) -> None:
    """Write the result into its run; maps and pushes of the same policy that were not measured again stay."""
    with contextlib.suppress(ArtifactError):
        before = robustness.read(file)
        measured = {"nominal", "maps", "push", "command", "versions"}
        if before.model_dump(mode="json", exclude=measured) == result.model_dump(mode="json", exclude=measured):
            result = result.model_copy(update={"maps": result.maps or before.maps, "push": result.push or before.push})
    try:
        files.write_json(file, result.model_dump(mode="json"))
    except OSError as error:
        output.err().print(f"warning: {file}: not written: {error.strerror}")


def check_gates(result: Robustness, gates: Gates) -> None:
    """Raise `AnswerIsNo` if the worst cell of all maps misses a gate; without maps, the nominal one.

    A cell in which the environment failed misses every gate.
    """
    failed = result.list_failed()
    if failed and gates != NO_GATES:
        raise AnswerIsNo(f"gate missed: the episodes could not be played at {failed[0]}")
    where, outcome = result.name_worst()
    if missed := gates.list_missed(outcome.success_rate, outcome.success_interval, outcome.mean_return):
        raise AnswerIsNo(f"gate missed in the worst cell, {where}: " + "; ".join(missed))


def format_command(result: Robustness, varied: RobustnessMap, cell: Cell) -> str:
    """Return the command that plays the episodes of one cell; it leaves out what the policy file has itself."""
    measured = _list_settings(result.parameters, result.reward_weights, result.events)
    settings = {name: value for name, value in measured.items() if name not in result.own_settings}
    settings["randomize"] = json.dumps(result.randomize)
    engine = result.sim
    for axis, value in zip(varied.axes, cell.values, strict=True):
        if axis.setting == robustness.SIM:
            engine = Engine("mujoco", value)
            continue
        settings[axis.setting] = str(int(value) if value.is_integer() else value)
    played = [result.task, "--policy"] if result.is_baseline else []
    words = [
        "rlctl",
        "eval",
        *played,
        result.policy_file,
        "--episodes",
        str(result.episodes),
        "--seed",
        str(result.seed),
    ]
    if result.other_task is not None:
        words += ["--task", result.other_task]
    if engine:
        words += ["--sim", str(engine)]
    if not result.deterministic:
        words.append("--stochastic")
    return shlex.join([*words, *(word for key, value in settings.items() for word in ("--set", f"{key}={value}"))])


def _list_settings(
    parameters: Mapping[str, Any], reward_weights: Mapping[str, float], events: Mapping[str, Mapping[str, Any]]
) -> dict[str, str]:
    """Return what `--set` takes for an environment, by name."""
    settings = {f"task.{name}": json.dumps(value) for name, value in parameters.items()}
    settings |= {f"reward_weights.{name}": json.dumps(value) for name, value in reward_weights.items()}
    for name, event in events.items():
        values = {f"events.{name}.{key}": json.dumps(value) for key, value in event.items()}
        settings |= values or {f"events.{name}": "{}"}
    return settings


def _find_own_settings(spec: EnvSpec, policy: LoadedPolicy | Baseline, request: EvalRequest) -> list[str]:
    """Return the names of settings of `spec` that an evaluation of the policy has without any `--set`."""
    if policy.info is None:
        return []
    own = policy.info.derive_spec(request.task, EnvChanges(randomize=spec.randomize))
    unchanged = _list_settings(own.parameters, own.reward_weights, own.events)
    measured = _list_settings(spec.parameters, spec.reward_weights, spec.events)
    return [name for name, value in measured.items() if unchanged.get(name) == value]
