"""What a training prints at its end."""

import shlex
from typing import Any

from rlctl import output
from rlctl.runs.diagnosis import Finding, diagnose, format_end
from rlctl.training.display import duration, percent
from rlctl.training.request import TrainResult


def show(result: TrainResult, json: str | None) -> None:
    """Print the result, what the training's records show, and what to type next; for `--json -` JSON instead."""
    findings = diagnose(result.run)
    if output.present(_to_json(result, findings), json):
        return
    lines = [result.note] if result.note else []
    lines += [*_format_result(result), *format_end(findings, shlex.quote(str(result.run.path)))]
    lines += [f"recording: rerun {shlex.quote(str(path))}" for path in result.recordings]
    if result.recordings:
        lines.append("  without a display, in a browser: rerun --serve-web FILE")
    lines += [f"run: {result.run.path}", "next:", *(f"  {command}" for command in list_next_commands(result))]
    for line in lines:
        output.out().print(line)


def list_next_commands(result: TrainResult) -> list[str]:
    """Return the next commands: export, or for a policy that never succeeded the diagnosis of its run."""
    run = shlex.quote(str(result.run.path))
    score = result.best.evaluation if result.best else None
    fails = score is not None and score.success == 0
    tensorboard = f"tensorboard --logdir {shlex.quote(str(result.run.tensorboard))}"
    second = f"rlctl runs show {run}" if fails else f"rlctl export {run} --onnx"
    return [f"rlctl eval {run}", second, f"rlctl replay {run}", tensorboard]


def _to_json(result: TrainResult, findings: list[Finding]) -> dict[str, Any]:
    progress, stages = result.progress, len(result.recipe.stages)
    score = result.best.evaluation if result.best else None
    return {
        "run": str(result.run.path),
        "task": result.task,
        "steps": result.steps,
        "seconds": round(progress.seconds, 3),
        "wall_seconds": round(result.wall_seconds, 3),
        "best": {
            "step": result.best.training_steps if result.best else None,
            "success_rate": score.success if score else None,
            "mean_return": score.mean_return if score else None,
            "episodes": result.recipe.eval.episodes,
            "policy": str(result.run.best_policy),
        },
        **({"stage": progress.stage, "stages": stages} if stages else {}),
        "findings": findings,
        "recordings": [str(path) for path in result.recordings],
        "note": result.note,
    }


def _format_result(result: TrainResult) -> list[str]:
    progress, stages = result.progress, len(result.recipe.stages)
    line = f"trained {result.task}: {result.steps:,} steps in {duration(progress.seconds)}"
    if result.wall_seconds >= progress.seconds + 3:
        line += f" ({duration(result.wall_seconds)} with start, check and end)"
    lines = [line]
    if result.best is not None and (score := result.best.evaluation) is not None:
        success = "" if score.success is None else f"success {percent(score.success)}, "
        lines.append(
            f"best at step {result.best.training_steps:,}: {success}return {score.mean_return:.2f} "
            f"(mean of {output.format_count(result.recipe.eval.episodes, 'episode')})"
        )
    if stages:
        short = "" if progress.stage == stages else "; evaluations used the last stage, which training did not reach"
        lines.append(f"ended in stage {progress.stage} of {stages}{short}")
    return lines
