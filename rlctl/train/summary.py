"""What a training prints at its end."""

from __future__ import annotations

from typing import Any

from rlctl import output
from rlctl.runs.diagnosis import Finding, diagnose
from rlctl.runs.diagnosis.show import as_json, format_end
from rlctl.train.display import duration, percent
from rlctl.train.request import TrainResult


def show(result: TrainResult, json: str | None) -> None:
    """Print the result, what the training's records show, and what to type next; for `--json -` JSON instead."""
    findings = diagnose(result.run)
    if json is not None:
        output.write_result_json(json, _to_json(result, findings))
    if json == "-":
        return
    run = result.run.path
    lines = [result.note] if result.note else []
    lines += [*_format_result(result), *format_end(findings, str(run))]
    lines += [f"recording: rerun {path}" for path in result.recordings]
    if result.recordings:
        lines.append("  without a display, in a browser: rerun --serve-web FILE")
    lines += [
        f"run: {run}",
        "next:",
        f"  rlctl eval {run}",
        f"  rlctl export {run} --onnx",
        f"  rlctl replay {run}",
        f"  tensorboard --logdir {result.run.tensorboard}",
    ]
    for line in lines:
        output.out().print(line, markup=False)


def _to_json(result: TrainResult, findings: list[Finding]) -> dict[str, Any]:
    return {
        "run": str(result.run.path),
        "task": result.task,
        "steps": result.steps,
        "seconds": round(result.seconds, 3),
        "wall_seconds": round(result.wall_seconds, 3),
        "best": {
            "step": result.best_step,
            "success_rate": result.best_success,
            "mean_return": result.best_return,
            "episodes": result.eval_episodes,
            "policy": str(result.run.best_policy),
        },
        **({"stage": result.stage, "stages": result.stages} if result.stages else {}),
        "findings": as_json(findings),
        "recordings": [str(path) for path in result.recordings],
        "note": result.note,
    }


def _format_result(result: TrainResult) -> list[str]:
    lines = [f"trained {result.task}: {result.steps:,} steps in {duration(result.seconds)}{_format_wall(result)}"]
    if result.best_return is not None and result.best_step is not None:
        success = "" if result.best_success is None else f"success {percent(result.best_success)}, "
        lines.append(
            f"best at step {result.best_step:,}: {success}return {result.best_return:.2f} "
            f"(mean of {result.eval_episodes} episodes)"
        )
    if result.stages:
        short = "" if result.stage == result.stages else "; evaluated in the last, which it did not reach"
        lines.append(f"ended in stage {result.stage} of {result.stages}{short}")
    return lines


def _format_wall(result: TrainResult) -> str:
    """Return how long the whole command took, where that is clearly more than the training."""
    if result.wall_seconds < result.seconds + 3:
        return ""
    return f" ({duration(result.wall_seconds)} with start, check and end)"
