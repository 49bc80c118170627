"""`rlctl gate`."""

from pathlib import Path
from typing import Annotated

import typer

from rlctl.arguments import choose_checkpoint, command_in_panels, parse_changes
from rlctl.errors import UsageError
from rlctl.evaluation.eval_request import MinReturn, MinSuccess, MinSuccessLower
from rlctl.options import Checkpoint, EpisodeSeed, Json, Junit, Option, Pretrained, RunName, Settings, SimOption


@command_in_panels(
    {
        "Options": ["task", "checkpoint", "pretrained", "episodes", "seed", "settings", "sim"],
        "Check": ["no_check", "strict", "budget"],
        "Gates": ["min_success", "min_success_lower", "min_return", "decide_early"],
        "Comparison": ["against", "margin", "allow_no_success"],
        "Output": ["export", "json", "junit", "sarif", "markdown"],
    }
)
def gate(
    run: RunName = None,
    task: Annotated[str | None, Option("Judge on this task instead of the one it was trained on.")] = None,
    checkpoint: Checkpoint = "best",
    pretrained: Pretrained = False,
    episodes: Annotated[int, Option("Episodes, each with its own seed.", min=2, max=1_000_000)] = 100,
    seed: EpisodeSeed = 0,
    settings: Settings = [],
    sim: SimOption = None,
    no_check: Annotated[bool, Option("Leave out the check of the environment.", ("--no-check",))] = False,
    strict: Annotated[bool, Option("Warnings of the check fail too.", ("--strict",))] = False,
    budget: Annotated[
        float | None,
        Option(
            "Computing time in seconds of each process of the check.",
            min=1,
            default_text="18, and up to 90 for slow environments",
        ),
    ] = None,
    min_success: MinSuccess = None,
    min_success_lower: MinSuccessLower = None,
    min_return: MinReturn = None,
    decide_early: Annotated[bool, Option("End the evaluation when its gate is decided.", ("--decide-early",))] = False,
    against: Annotated[Path | None, Option("The policy in use; the new one must not be worse.", metavar="FILE")] = None,
    margin: Annotated[
        float | None, Option("The episodes must exclude a larger loss of success, e.g. 0.05.", min=0)
    ] = None,
    allow_no_success: Annotated[
        bool, Option("Let the comparison pass where neither ever succeeds.", ("--allow-no-success",))
    ] = False,
    export: Annotated[
        Path | None, Option("File to write if all steps pass, .onnx or .c; it is verified.", metavar="FILE")
    ] = None,
    json: Json = None,
    junit: Junit = None,
    sarif: Annotated[Path | None, Option("Also write what the check found as SARIF.", metavar="FILE")] = None,
    markdown: Annotated[
        Path | None, Option("Also write the report as Markdown, for a pull request.", metavar="FILE")
    ] = None,
) -> None:
    """Check, evaluate, compare with the policy in use, and export: one report and one exit code, for CI."""
    from rlctl.evaluation.eval_request import EvalRequest, Gates
    from rlctl.gating.gate import GateRequest, run_gate
    from rlctl.gating.report import show, show_step
    from rlctl.runs.compare.comparison import ComparisonGate

    if no_check:
        for name, value in (("--strict", strict), ("--budget", budget), ("--sarif", sarif)):
            if value:
                raise UsageError(f"{name} is for the check, which --no-check leaves out")
    evaluation = EvalRequest(
        run,
        task=task,
        checkpoint=choose_checkpoint(checkpoint, pretrained),
        episodes=episodes,
        seed=seed,
        decide_early=decide_early,
        changes=parse_changes(settings, sim),
    )
    request = GateRequest(
        evaluation=evaluation,
        gates=Gates(min_success, min_success_lower, min_return),
        against=against,
        comparison=ComparisonGate(margin, allow_no_success=allow_no_success),
        export=export,
        strict=strict,
        budget_s=budget,
        checks=not no_check,
    )
    report = run_gate(request, show_step, quiet=json == "-")
    show(report, json, junit, sarif, markdown)
    raise typer.Exit(report.exit_code)
