"""`rlctl eval --vary` and `--push`: how robust a policy is, with the same episodes in every cell."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from rlctl import output
from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo, ArtifactError, UsageError
from rlctl.evaluation import axes as axes_of
from rlctl.evaluation.cells import CellPlayer
from rlctl.evaluation.episode_statistics import summarize
from rlctl.evaluation.evaluate import NO_GATES, Gates, find_player, start_workers
from rlctl.evaluation.push import measure_push
from rlctl.evaluation.request import EvalRequest
from rlctl.run import robustness
from rlctl.run.robustness import Axis, Cell, Robustness, RobustnessMap
from rlctl.version import collect_versions

ASK_ABOVE_S = 600.0
"""A measurement that takes longer than this [s] is begun only after asking."""


def measure_robustness(
    request: EvalRequest,
    vary: Sequence[str] = (),
    *,
    push: bool = False,
    sim: str | None = None,
    yes: bool = False,
    gates: Gates = NO_GATES,
) -> Robustness:
    """Measure a policy in every cell of the maps that `vary` asks for, and with pushes, and keep the result in its run.

    `vary` is `NAME=LOWEST:HIGHEST:VALUES`, one or two, or `all`. `sim` is `mujoco`, or `mujoco:SOLREF` with a time
    constant of contacts [s]: the same episodes in another physics engine. `yes` begins a long measurement unasked.
    Random changes that the policy was trained with do not act, unless the request's own changes say so.
    """
    if request.changes.randomize is None:
        request = dataclasses.replace(request, changes=dataclasses.replace(request.changes, randomize=False))
    found, policy, spec = find_player(request)
    maps = axes_of.read_axes(vary, spec) if vary else []
    if sim is not None:
        dataclasses.replace(spec, sim=sim).make().close()  # raises, before anything is played, for what MuJoCo has not
        maps.append([axes_of.make_contact_axis(sim)])
    cells = axes_of.count_cells(maps)  # raises for too many, before one is played
    with start_workers(spec, request) as workers:
        policy.give_to(workers)
        player = CellPlayer(workers, policy, request)
        start = time.monotonic()
        episodes = player.play(spec)
        nominal = summarize(episodes)
        gates.check_possible(nominal.success_rate is not None)
        _ask(cells, time.monotonic() - start, yes)
        with output.show_progress("varying", cells) as show:
            done = itertools.count(1)
            measured = [_play_map(player, spec, axes, lambda: show(next(done))) for axes in maps]
        pushed = measure_push(player, spec, episodes) if push else None
    result = Robustness(
        task=spec.task,
        parameters=dict(spec.parameters),
        reward_weights=dict(spec.reward_weights),
        events={name: dict(event) for name, event in spec.events.items()},
        policy_file=str(found.file),
        algo=policy.info.algo,
        training_steps=policy.info.training_steps,
        episodes=request.episodes,
        seed=request.seed,
        deterministic=request.deterministic,
        nominal=nominal,
        maps=measured,
        push=pushed,
        command=shlex.join(["rlctl", *sys.argv[1:]]),
        versions=collect_versions(),
    )
    if found.run is not None and request.task in (None, policy.info.spec.task):
        _keep(found.run.robustness_file, result)
    return result


def _play_map(player: CellPlayer, spec: EnvSpec, axes: list[Axis], on_cell: Callable[[], None]) -> RobustnessMap:
    places = list(itertools.product(*(axis.values for axis in axes)))
    specs = [_apply(axes, values, spec) for values in places]
    cells: dict[int, Cell] = {}
    # Another parameter of the task means other worlds: cells that share it are played one after the other.
    for index in sorted(range(len(places)), key=lambda index: sorted(specs[index].parameters.items(), key=repr)):
        outcome = summarize(player.play(specs[index]))
        cells[index] = Cell(
            **outcome.model_dump(), values=list(places[index]), nominal=_is_nominal(axes, places[index])
        )
        on_cell()
    return RobustnessMap(axes=axes, cells=[cells[index] for index in range(len(places))])


def _apply(axes: Sequence[Axis], values: Sequence[float], spec: EnvSpec) -> EnvSpec:
    for axis, value in zip(axes, values, strict=True):
        is_engine = axis.setting == axes_of.SIM
        spec = (
            dataclasses.replace(spec, sim=f"mujoco:{value:g}") if is_engine else axes_of.change(axis, value).apply(spec)
        )
    return spec


def _is_nominal(axes: Sequence[Axis], values: Sequence[float]) -> bool:
    pairs = zip(axes, values, strict=True)
    return all(axis.nominal is not None and abs(axis.nominal - value) < 1e-9 for axis, value in pairs)


def _ask(cells: int, seconds: float, yes: bool) -> None:
    """Say how long many cells will take and ask whether to begin; raises `UsageError` where nobody can be asked."""
    total = cells * seconds
    if yes or total <= ASK_ABOVE_S:
        return
    duration = output.format_duration(total)
    expected = f"{cells:,} cells will take about {duration}: the nominal one took {seconds:.1f} s"
    refusal = f"--vary: {expected}; take fewer values or --episodes, or begin all the same: --yes"
    if not output.confirm(f"{expected}; begin?", refusal):
        raise UsageError("--vary: not begun")


def _keep(file: Path, result: Robustness) -> None:
    """Write the result into its run, with what was measured before of the same policy in the same way."""
    with contextlib.suppress(ArtifactError):
        before = robustness.read(file)
        measured = {"nominal", "maps", "push", "command", "versions"}
        if before.model_dump(mode="json", exclude=measured) == result.model_dump(mode="json", exclude=measured):
            kept = {"maps": result.maps or before.maps, "push": result.push or before.push}
            result = result.model_copy(update=kept)
    try:
        robustness.write(file, result)
    except OSError as error:
        output.err().print(f"warning: {file}: not written: {error.strerror}")


def check_gates(result: Robustness, gates: Gates) -> None:
    """Raise `AnswerIsNo` if the worst cell of all maps misses a gate; without maps, the nominal one."""
    worst = result.find_worst()
    where, outcome = ("nominal", result.nominal) if worst is None else (worst[0].name_cell(worst[1]), worst[1])
    if missed := gates.list_missed(outcome.success_rate, outcome.success_interval, outcome.mean_return):
        raise AnswerIsNo(f"gate missed in the worst cell, {where}: " + "; ".join(missed))
