"""`rlctl runs` and its commands."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperGroup

from rlctl.arguments import command, parse_changes
from rlctl.errors import UsageError
from rlctl.importing.foreign.request import NO_FILES, ForeignFiles
from rlctl.options import (
    TASK_FORMS,
    Argument,
    EpisodeSeed,
    Json,
    Junit,
    Option,
    PictureFile,
    RunName,
    RunsFolder,
    Settings,
    Yes,
)

if TYPE_CHECKING:
    from rlctl.evaluation.eval_request import EvalRequest


class _RunsGroup(TyperGroup):
    """Reads `rlctl runs [TASK]` as `rlctl runs list [TASK]`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args or (args[0] not in self.commands and args[0] not in ctx.help_option_names):
            args = ["list", *args]
        return super().parse_args(ctx, args)


DryRun = Annotated[bool, Option("Only list what would be removed.", ("--dry-run",))]

app = typer.Typer(cls=_RunsGroup, help="List runs, show one, report and compare them, remove what is not needed.")


@app.command("list")
@command
def list_runs(
    task: Annotated[str | None, Argument("Only the runs of this task.", metavar="[TASK]")] = None,
    sort: Annotated[Literal["newest", "score", "steps", "minutes"], Option("Order.")] = "newest",
    output: RunsFolder = Path("runs"),
    json: Json = None,
) -> None:
    """List every run below a folder. `rlctl runs` alone does the same."""
    from rlctl.runs.listing import list_runs, show

    commands = [command.name for command in app.registered_commands if command.name]
    show(list_runs(task, sort=sort, root=output, commands=commands, waiting=True), json, output)


@app.command("show")
@command
def show_run(
    run: RunName = None,
    json: Json = None,
    audit: Annotated[
        bool, Option("First play its policy against scripted competitors: what has it learned?", ("--audit",))
    ] = False,
    env_timeout: Annotated[
        float | None,
        Option(
            "How long a step or reset of --audit may take.", metavar="SECONDS", min=0.1, max=1e6, default_text="10.0"
        ),
    ] = None,
) -> None:
    """Show a run: its recipe, curve, evaluations, warnings and files."""
    from rlctl.runs.lookup import find_run
    from rlctl.runs.report.audited import audit_run
    from rlctl.runs.report.show import RunDescription, show

    if env_timeout is not None and not audit:
        raise UsageError("--env-timeout: nothing is played without --audit")
    found = find_run(run)
    if audit:
        audit_run(found, env_timeout_s=10.0 if env_timeout is None else env_timeout)
    show(RunDescription(found), json)


@app.command("report")
@command
def report_runs(
    runs: Annotated[
        list[str],
        Argument("Runs, groups, globs or folders of runs, all of one task.", metavar="RUN", default_text="latest"),
    ] = [],
    output: Annotated[
        Path | None,
        Option("Default: report.FORMAT; md, table, csv and latex go to stdout.", ("--output", "-o"), metavar="FILE"),
    ] = None,
    format: Annotated[
        Literal["html", "md", "table", "csv", "latex", "svg", "pdf", "png"] | None,
        Option(
            "A page, text for pull requests, the results alone (table, csv, latex), or the learning curves alone.",
            default_text="by the suffix of --output, else html",
        ),
    ] = None,
    label: Annotated[
        list[str], Option("Name of a recipe in curves and tables; once per recipe, in the order of the runs.")
    ] = [],
    pictures: Annotated[bool, Option("Do not replay episodes to draw pictures.", ("/--no-pictures",))] = True,
    episodes: Annotated[
        int | None,
        Option(
            "Episodes that each run plays to compare recipes; 0: do not compare.",
            min=0,
            max=1_000_000,
            default_text="100",
        ),
    ] = None,
) -> None:
    """Write the result of runs as one file: verdict, curves, evaluations, diagnosis, pictures, how to reproduce it."""
    from rlctl import output as streams
    from rlctl.runs.report.write import write_report

    path = write_report(runs or ["latest"], format, output, pictures=pictures, episodes=episodes, labels=label)
    if path is not None:
        streams.out().print(f"report: {path}")


@app.command("compare")
@command
def compare_runs(
    runs: Annotated[
        list[str],
        Argument("Runs, policy files, groups, globs or folders of runs; the first is the baseline.", metavar="RUN"),
    ],
    episodes: Annotated[int, Option("Episodes that each run plays.", min=2, max=1_000_000)] = 100,
    seed: EpisodeSeed = 0,
    task: Annotated[str | None, Option("Evaluate all policies on this task.")] = None,
    settings: Settings = [],
    threshold: Annotated[
        float | None, Option("Report the steps until this success rate (or return); default for success: 0.9.")
    ] = None,
    force: Annotated[
        bool, Option("Compare although the task has changed or a seed is unfinished.", ("--force",))
    ] = False,
    gate: Annotated[
        Literal["not-worse", "better"] | None,
        Option("Exit 1 if any is worse than the first, or unless all are shown to be better."),
    ] = None,
    margin: Annotated[
        float | None, Option("Exit 1 unless the episodes exclude a larger loss of success, e.g. 0.05.", min=0)
    ] = None,
    allow_no_success: Annotated[
        bool, Option("Let the gate pass where neither ever succeeds.", ("--allow-no-success",))
    ] = False,
    vary: Annotated[
        list[str],
        Option(
            "Compare two policies in a map of the difference, e.g. mass=0.6:1.4:5; give it twice for a 2-D map.",
            metavar="NAME=LOW:HIGH:COUNT|all",
        ),
    ] = [],
    picture: PictureFile = None,
    yes: Yes = False,
    json: Json = None,
    junit: Junit = None,
) -> None:
    """Test whether a policy, or a recipe trained with several seeds, is better than another."""
    from rlctl.evaluation.eval_request import EvalRequest
    from rlctl.runs.compare.comparison import ComparisonGate, compare
    from rlctl.runs.compare.report import make_suite, show
    from rlctl.storage.junit import write as write_junit

    began = time.monotonic()
    changes = parse_changes(settings)
    request = EvalRequest(None, task=task, episodes=episodes, seed=seed, changes=changes)
    if vary:
        if gate or margin is not None or junit is not None:
            raise UsageError("--vary draws a map and judges nothing: leave out --gate, --margin and --junit")
        _compare_maps(runs, request, vary, picture, yes=yes, json=json)
        return
    if picture is not None:
        raise UsageError("--picture draws maps: add --vary, or draw learning curves: rlctl runs report --format png")
    is_better = gate == "better"
    if is_better and margin is not None:
        raise UsageError("--gate better and --margin exclude each other: a margin is of --gate not-worse")
    result = compare(runs, request, threshold, force=force, margin=margin)
    asked = ComparisonGate(margin, is_better, allow_no_success) if gate or margin is not None else None
    show(result, json, asked)
    if junit is not None:
        write_junit(junit, [make_suite(result, asked, time.monotonic() - began)])
    if asked:
        result.check(asked)


def _compare_maps(
    runs: list[str], request: "EvalRequest", vary: list[str], picture: Path | None, *, yes: bool, json: str | None
) -> None:
    from rlctl.runs.compare.maps import compare_maps, show

    if picture is None:
        show(compare_maps(runs, request, vary, yes=yes), json)
        return
    from rlctl.runs.report.plots import choose_form, draw_differences
    from rlctl.storage import files

    form = choose_form(picture)  # before any episode is played
    result = compare_maps(runs, request, vary, yes=yes)
    show(result, json)
    files.write_result(picture, draw_differences(result, form))


@app.command("import")
@command
def import_run(
    file: Annotated[
        Path,
        Argument(
            "Model of Stable-Baselines3 or rl-zoo3; with --deploy or --model ONNX or TorchScript.", metavar="MODEL"
        ),
    ],
    task: Annotated[str | None, Option(f"The task it was trained on. {TASK_FORMS}", metavar="TASK")] = None,
    vecnormalize: Annotated[
        Path | None, Option("Its normalisation; none: it has none, although one is near it.", metavar="FILE.pkl|none")
    ] = None,
    algo: Annotated[str | None, Option("Its algorithm, if the file does not name it.")] = None,
    foreign: ForeignFiles = NO_FILES,
    settings: Settings = [],
    output: Annotated[
        Path | None, Option("Policy file to write. Default: MODEL.safetensors.", ("--output", "-o"), metavar="FILE")
    ] = None,
    json: Json = None,
) -> None:
    """Convert a model of Stable-Baselines3, or a policy of another project. Nothing in the model is executed."""
    if foreign.is_given:
        if task is not None or vecnormalize is not None or algo is not None:
            raise UsageError(
                "--deploy and --model are of a policy of another project: leave out --task, --vecnormalize and --algo"
            )
        _import_foreign(file, foreign, settings, output, json)
        return
    if task is None:
        raise UsageError(
            "give the task that the model was trained on, --task TASK; "
            "or of a policy of another project --deploy FILE --model ROBOT"
        )
    from rlctl.importing.import_model import choose_normalization, import_model, show

    changes, normalization = parse_changes(settings), choose_normalization(file, vecnormalize)
    policy = import_model(file, task, normalization=normalization, algo=algo, output=output, changes=changes)
    show(policy, json)


def _import_foreign(
    policy: Path, foreign: ForeignFiles, settings: list[str], output: Path | None, json: str | None
) -> None:
    from rlctl.importing.foreign.import_policy import import_policy, show
    from rlctl.recipe.sources import parse_settings

    show(import_policy(policy, foreign, settings=parse_settings(settings), output=output), json)


@app.command("rm")
@command
def remove_runs(
    runs: Annotated[list[str], Argument("Folders of runs.", metavar="RUN")] = [],
    keep_best: Annotated[
        int | None,
        Option(
            "Keep the N best runs of each task and all groups; remove the other finished or failed runs.",
            metavar="N",
            min=0,
        ),
    ] = None,
    yes: Yes = False,
    dry_run: DryRun = False,
) -> None:
    """Remove runs, except those that are being trained."""
    from rlctl.runs.listing import plan_removal, remove_with_report

    remove_with_report(plan_removal(runs, keep_best=keep_best), yes=yes, dry_run=dry_run)


@app.command("prune")
@command
def prune_runs(
    runs: Annotated[
        list[str], Argument("Runs, groups, globs or folders of runs.", metavar="RUN", default_text="all")
    ] = [],
    yes: Yes = False,
    dry_run: DryRun = False,
) -> None:
    """Remove the checkpoints of finished runs, which are needed only to train longer."""
    from rlctl.runs.listing import plan_prune, remove_with_report

    remove_with_report(plan_prune(runs), yes=yes, dry_run=dry_run)


@command
def report_bug(run: RunName = None) -> None:
    """Print what a bug report needs: versions, recipe, last lines and diagnosis of a run, nothing personal."""
    from rlctl import output
    from rlctl.runs.bug_report import write_bug_report

    output.results().write(write_bug_report(run))
