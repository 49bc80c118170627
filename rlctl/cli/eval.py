"""`rlctl eval` and `rlctl replay`."""

import dataclasses
import itertools
import re
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

from typer.core import TyperCommand

from rlctl.arguments import choose_checkpoint, command_in_panels, parse_changes
from rlctl.errors import UsageError
from rlctl.evaluation.eval_request import EvalOptions, EvalRequest, Gates, MinReturn, MinSuccess, MinSuccessLower
from rlctl.importing.foreign.request import NO_FILES, ForeignFiles
from rlctl.options import Cluster, Json, Junit, On, Option, PictureFile, Pretrained, Settings, SimOption, Yes
from rlctl.replaying.replay_request import ReplayRequest


@command_in_panels(
    {
        "Options": ["episodes", "seed", "checkpoint", "pretrained", "baseline", "task", "settings", "stage"],
        "Gates": ["min_success", "min_success_lower", "min_return", "decide_early"],
        "Robustness": ["vary", "push", "yes"],
        "A policy of another project": ["deploy", "model", "terrain", "motion", "motion_rate"],
        "How": ["sim", "deterministic", "limits", "env_timeout_s"],
        "Where": ["n_envs", "on", "cluster"],
        "Output": ["record", "picture", "json", "junit"],
    }
)
def evaluate(
    options: EvalOptions,
    pretrained: Pretrained = False,
    settings: Settings = [],
    foreign: ForeignFiles = NO_FILES,
    min_success: MinSuccess = None,
    min_success_lower: MinSuccessLower = None,
    min_return: MinReturn = None,
    vary: Annotated[
        list[str],
        Option(
            "Vary an event or parameter of the task, e.g. mass=0.6:1.4:9, or with sim MuJoCo's contacts; give it "
            "twice for a 2-D map.",
            metavar="NAME=LOW:HIGH:COUNT|sim|all",
        ),
    ] = [],
    push: Annotated[bool, Option("Find the smallest push at which the policy fails.", ("--push",))] = False,
    sim: SimOption = None,
    yes: Yes = False,
    on: On = None,
    cluster: Cluster = None,
    picture: PictureFile = None,
    json: Json = None,
    junit: Junit = None,
) -> None:
    """Evaluate a policy: success rate with its interval, returns, reward terms."""
    from rlctl.evaluation import junit as suites
    from rlctl.evaluation.evaluate import run_evaluation
    from rlctl.evaluation.group_scores import evaluate_group
    from rlctl.evaluation.report import show, show_group, show_robustness
    from rlctl.output import print_notes
    from rlctl.runs.directory import is_group
    from rlctl.runs.group import read_group
    from rlctl.storage.junit import write as write_junit

    began = time.monotonic()
    gates = Gates(min_success, min_success_lower, min_return)
    if foreign.is_given:
        run, settings = _import_foreign(options.run, options.baseline, foreign, settings)
        options = dataclasses.replace(options, run=run)
    chosen = dataclasses.replace(options, checkpoint=choose_checkpoint(options.checkpoint, pretrained))
    request = EvalRequest(**vars(chosen), changes=parse_changes(settings, sim))
    if on is not None and not vary:
        raise UsageError("--on needs a robustness map: give --vary too")
    if picture is not None:
        if not vary:
            raise UsageError("--picture draws maps: give --vary too")
        from rlctl.runs.report import plots
        from rlctl.storage import files

        plots.choose_form(picture)  # raises before any episode is played
    if sim is not None and sim.name == "mujoco" and not vary:
        print_notes([f"--sim {sim} plays in one engine; to vary the stiffness of its contacts: --vary sim"])
    if vary or push:
        unsupported: dict[str, object] = {
            "--limits": request.limits,
            "--record": request.record,
            "--decide-early": request.decide_early or None,
        }
        if option := next((name for name, value in unsupported.items() if value is not None), None):
            raise UsageError(f"{option} cannot be combined with --vary or --push")
        from rlctl.cluster.executors import choose_cell_player
        from rlctl.evaluation.vary import check_gates, measure_robustness

        play = choose_cell_player(on, cluster)
        robustness = measure_robustness(request, vary, push=push, yes=yes, gates=gates, play_cells=play)
        show_robustness(robustness, json)
        if picture is not None:
            files.write_result(picture, plots.draw_maps(robustness, plots.choose_form(picture)))
        if junit is not None:
            write_junit(junit, [suites.make_robustness_suite(robustness, gates, time.monotonic() - began)])
        return check_gates(robustness, gates)
    if request.run is not None and request.baseline is None and is_group(folder := Path(request.run)):
        if request.decide_early:
            raise UsageError("--decide-early is for one run: of a group every seed plays all episodes")
        scores = evaluate_group(read_group(folder), request)
        show_group(scores, json)
        if junit is not None:
            write_junit(junit, [suites.make_group_suite(scores, gates, time.monotonic() - began)])
        return scores.check(gates)
    result = run_evaluation(request, gates)
    show(result, json, gates)
    if junit is not None:
        write_junit(junit, [suites.make_suite(result, gates, time.monotonic() - began)])
    return result.check(gates)


def _import_foreign(
    policy: str | None, baseline: str | None, foreign: ForeignFiles, settings: list[str]
) -> tuple[str, list[str]]:
    """Import a policy of another project; return its file and the settings of the environment."""
    if baseline is not None:
        raise UsageError(f"--policy {baseline} plays a task: leave out --deploy, --model and --terrain")
    from rlctl.importing.foreign.import_policy import import_to_play

    return import_to_play(policy, foreign, settings)


_BY_OUTCOME = ("--worst", "--best", "--failures")


class ReplayCommand(TyperCommand):
    """Reads `--best RUN` as `--best 1 RUN`; the same for `--worst` and `--failures`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the missing counts, then parse as Typer does."""
        return super().parse_args(ctx, list(_fill_counts(args)))


def _fill_counts(arguments: Iterable[str]) -> Iterator[str]:
    for argument, following in itertools.pairwise([*arguments, ""]):
        yield argument
        # Only a number belongs to the option; any other word may be the run.
        if argument in _BY_OUTCOME and not re.fullmatch(r"[-+]?\d[\d.]*", following):
            yield "1"


@command_in_panels(
    {
        "Options": ["baseline", "checkpoint", "pretrained", "task", "verify"],
        "Episodes": ["episodes", "worst", "best", "failures", "seed", "settings"],
        "A policy of another project": ["deploy", "model", "terrain", "motion", "motion_rate"],
        "Where": ["gui", "sim"],
        "Output": ["output", "video", "seconds", "size", "camera", "json"],
    }
)
def replay(
    request: ReplayRequest, pretrained: Pretrained = False, foreign: ForeignFiles = NO_FILES, json: Json = None
) -> None:
    """Show what a policy does, or what a task does before any training: Rerun recordings, without a display.

    A function for --policy is act(observation) or act(observation, step) and returns an action; step counts from 0.
    """
    from rlctl.replaying.replay import run_replay
    from rlctl.replaying.report import show

    checkpoint = choose_checkpoint(request.checkpoint, pretrained)
    if foreign.is_given:
        source, settings = _import_foreign(request.source, request.baseline, foreign, request.settings)
        request = dataclasses.replace(request, source=source, settings=settings)
    result = run_replay(dataclasses.replace(request, checkpoint=checkpoint))
    show(result, json)
    result.check()
