"""`rlctl runs` and its commands."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperGroup

from rlctl.cli.arguments import TASK_FORMS, EpisodeSeed, Json, Run, Set, claim_stdout, parse_changes


class _RunsGroup(TyperGroup):
    """Reads `rlctl runs [TASK]` as `rlctl runs list [TASK]`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args or (args[0] not in self.commands and args[0] not in ctx.help_option_names):
            args = ["list", *args]
        return super().parse_args(ctx, args)


Yes = Annotated[bool, typer.Option("--yes", help="Do not ask.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Only list what would be removed.")]

app = typer.Typer(cls=_RunsGroup, help="List runs, show one, report and compare them, remove what is not needed.")


@app.command("list")
def list_runs(
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="Only the runs of this task.")] = None,
    sort: Annotated[Literal["newest", "score", "steps", "minutes"], typer.Option(help="Order.")] = "newest",
    json: Json = None,
) -> None:
    """List every run below ./runs. `rlctl runs` alone does the same."""
    from rlctl.runs.listing import list_runs, show

    commands = [command.name for command in app.registered_commands if command.name]
    show(list_runs(task, sort=sort, commands=commands, waiting=True), json)


@app.command("show")
def show_run(run: Run = None, json: Json = None) -> None:
    """Show a run: its recipe, curve, evaluations, warnings and files."""
    from rlctl.run.lookup import find_run
    from rlctl.runs.show import RunDescription, show

    show(RunDescription(find_run(run)), json)


@app.command("report")
def report_runs(
    runs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[RUN]", help="Runs, groups, globs or folders of runs, all of one task.", show_default="latest"
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="Default: report.html; md goes to stdout.")
    ] = None,
    format: Annotated[Literal["html", "md"], typer.Option(help="A page, or text for pull requests.")] = "html",
    pictures: Annotated[
        bool, typer.Option("--pictures/--no-pictures", help="Replay episodes to draw pictures.")
    ] = True,
    episodes: Annotated[
        int,
        typer.Option(help="Episodes that each run plays to compare recipes; 0: do not compare.", min=0, max=1_000_000),
    ] = 100,
) -> None:
    """Write the result of runs as one file: verdict, curves, evaluations, diagnosis, pictures, how to reproduce it."""
    claim_stdout()
    from rlctl import output as streams
    from rlctl.runs.report.write import write_report

    if (path := write_report(runs or ["latest"], format, output, pictures=pictures, episodes=episodes)) is not None:
        streams.out().print(f"report: {path}")


@app.command("compare")
def compare_runs(
    runs: Annotated[
        list[str],
        typer.Argument(metavar="RUN", help="Runs, groups, globs or folders of runs; the first is the baseline."),
    ],
    episodes: Annotated[int, typer.Option(help="Episodes that each run plays.", min=2, max=1_000_000)] = 100,
    seed: EpisodeSeed = 0,
    task: Annotated[str | None, typer.Option(help="Evaluate all on this task.")] = None,
    settings: Set = [],
    threshold: Annotated[
        float | None, typer.Option(help="Report the steps to this success rate (or return); 0.9 if success is known.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Compare even if the task has changed.")] = False,
    gate: Annotated[Literal["not-worse"] | None, typer.Option(help="Exit 1 if one is worse than the first.")] = None,
    json: Json = None,
) -> None:
    """Test whether a policy, or a recipe trained with several seeds, is better than another."""
    claim_stdout()
    from rlctl.evaluation.request import EvalRequest
    from rlctl.runs.comparison import compare
    from rlctl.runs.comparison_report import show

    changes = parse_changes(settings)
    result = compare(
        runs, EvalRequest(None, task=task, episodes=episodes, seed=seed, changes=changes), threshold, force=force
    )
    show(result, json)
    if gate:
        result.check()


@app.command("import")
def import_run(
    model: Annotated[Path, typer.Argument(metavar="MODEL.zip", help="Model of Stable-Baselines3 or rl-zoo3.")],
    task: Annotated[str, typer.Option(metavar="TASK", help=f"The task it was trained on. {TASK_FORMS}")],
    vecnormalize: Annotated[
        Path | None, typer.Option(metavar="FILE.pkl", help="Its normalisation, if it has one.")
    ] = None,
    algo: Annotated[str | None, typer.Option(help="Its algorithm, if the file does not name it.")] = None,
    settings: Set = [],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Policy file to write. Default: MODEL.safetensors."),
    ] = None,
    json: Json = None,
) -> None:
    """Convert a model of Stable-Baselines3 to a policy file. Nothing in the model is unpickled."""
    claim_stdout()
    from rlctl.importing.import_model import import_model, show

    changes = parse_changes(settings)
    show(import_model(model, task, normalization=vecnormalize, algo=algo, output=output, changes=changes), json)


@app.command("rm")
def remove_runs(
    runs: Annotated[list[str] | None, typer.Argument(metavar="RUN", help="Folders of runs.")] = None,
    keep_best: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Keep the N best runs of each task, remove the other finished or failed ones; groups stay.",
            min=0,
        ),
    ] = None,
    yes: Yes = False,
    dry_run: DryRun = False,
) -> None:
    """Remove runs, never one that is being trained."""
    from rlctl.runs.removal import plan_removal, remove_with_report

    remove_with_report(plan_removal(runs or [], keep_best=keep_best), yes=yes, dry_run=dry_run)


@app.command("prune")
def prune_runs(
    runs: Annotated[
        list[str] | None,
        typer.Argument(metavar="RUN", help="Runs, groups, globs or folders of runs.", show_default="all"),
    ] = None,
    yes: Yes = False,
    dry_run: DryRun = False,
) -> None:
    """Remove the checkpoints of finished runs, which are needed only to train longer."""
    from rlctl.runs.removal import plan_prune, remove_with_report

    remove_with_report(plan_prune(runs or []), yes=yes, dry_run=dry_run)
