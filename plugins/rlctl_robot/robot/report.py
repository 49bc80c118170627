"""What `rlctl robot` prints."""

import dataclasses
from typing import Any

import numpy as np
from pydantic_core import to_jsonable_python

from rlctl import output
from rlctl.evaluation.eval_request import Gates
from rlctl.task.events.event import describe_randomization
from rlctl.version import collect_versions
from rlctl_robot.robot.robot import FaultScore, RobotReport

_NO_FAULT = "no fault"


def show(report: RobotReport, json: str | None, gates: Gates) -> None:
    """Print the scores of a program, or JSON alone for `-`."""
    if output.present(as_json(report) | {"gates": vars(gates), "gates_missed": report.list_missed(gates)}, json):
        return
    out = output.out()
    clock = "real time" if report.realtime else "lock-step"
    out.print(f"{report.spec.task}: controlled by {report.controller}, {clock}")
    if not report.scores:
        return
    episodes = output.format_count(len(report.scores[0].episodes), "episode")
    settings = f"seed {report.seed}", report.spec.engine_title, describe_randomization(report.info.events)
    out.print(", ".join(filter(None, [episodes, *settings])))
    has_success = report.scores[0].outcome.success_rate is not None
    columns = (
        "",
        *(("success", "95 % interval") if has_success else ()),
        "return",
        "steps",
        "steps/s",
        "held",
        "dropped",
    )
    output.print_table(columns, [_list_scores(score) for score in report.scores], left=("",))
    _show_times(report)
    _show_differences(report)
    if report.scores[0].outcome.success_rate == 0:
        out.print(describe_failures(report.scores[0]), soft_wrap=True)
    for score in report.scores:
        if score.commands.refused:
            out.print(
                f"{_name(score)}: {score.commands.refused:,} messages were no command, the first: "
                f"{score.commands.first_problem}"
            )


def describe_failures(score: FaultScore) -> str:
    """Return how the episodes of a program without any success ended, and what searches for the cause."""
    counts, episodes = score.commands, len(score.episodes)
    if counts.tilted is not None:
        how = f"the robot was not upright at the end of {counts.tilted} of {episodes}"
    elif counts.terminated:
        how = f"the task ended {counts.terminated} of {episodes} early, such as after a fall"
    else:
        how = "none ended early"
    return f"no episode succeeded: {how}; rlctl diagnose LOG searches your program's log for the cause"


def _name(score: FaultScore) -> str:
    return score.faults.text or _NO_FAULT


def _list_scores(score: FaultScore) -> list[str]:
    outcome, steps = score.outcome, _count_steps(score)
    cells = [_name(score)]
    if outcome.success_rate is not None and outcome.success_interval is not None:
        low, high = outcome.success_interval
        cells += [f"{outcome.success_rate:.1%}", f"{low:.1%} to {high:.1%}"]
    counts = score.commands
    return [*cells, f"{outcome.mean_return:.4g}", f"{steps:,}", f"{steps / score.seconds:,.0f}", f"{counts.held:,}",
            f"{counts.lost:,}"]  # fmt: skip


def _count_steps(score: FaultScore) -> int:
    return sum(episode.length for episode in score.episodes)


def _show_times(report: RobotReport) -> None:
    dt = report.info.control_dt
    late = "late" if dt is None else f"later than {1e3 * dt:.3g} ms"
    rows = []
    for score in report.scores:
        counts = score.commands
        times = [f"{1e3 * seconds:.3g}" for seconds in counts.quantiles()]
        cells = [_name(score), f"{len(counts.response_s):,}", *times, f"{counts.late:,}", f"{counts.unanswered:,}"]
        if report.realtime:
            p99, worst = np.quantile(counts.robot_late_s, (0.99, 1.0)).tolist()
            cells.append(f"{1e3 * p99:.3g}, {1e3 * worst:.3g}")
        rows.append(cells)
    own = ("robot late p99, worst [ms]",) if report.realtime else ()
    output.print_table(
        ("", "commands", "p50 [ms]", "p99 [ms]", "worst [ms]", late, "unanswered", *own), rows, left=("",)
    )


def _show_differences(report: RobotReport) -> None:
    if report.policy is None:
        return
    out = output.out()
    for score in report.scores:
        if not score.commands.differences:
            out.print(f"{_name(score)}: no command could be compared with {report.policy}")
            continue
        worst = max(score.commands.differences, key=lambda difference: difference.largest)
        mean = float(np.mean([difference.mean for difference in score.commands.differences]))
        out.print(
            f"{_name(score)}: {score.commands.compared:,} commands differ from the policy's ({report.command}) by "
            f"{mean:.3g} on average, at most {worst.largest:.3g} ({worst.name}, episode {worst.episode}, "
            f"step {worst.step})"
        )


def as_json(report: RobotReport) -> dict[str, Any]:
    """Return a report as plain data."""
    return dict(
        to_jsonable_python(
            {
                "task": {"name": report.spec.task, "parameters": report.spec.parameters},
                "controller": report.controller,
                "command": report.command,
                "policy": report.policy,
                "versions": collect_versions(),
                "events": report.info.events,
                "seed": report.seed,
                "realtime": report.realtime,
                "control_dt": report.info.control_dt,
                "problem": report.problem,
                "scores": [_describe(score) for score in report.scores],
            },
            inf_nan_mode="null",
        )
    )


def _describe(score: FaultScore) -> dict[str, Any]:
    counts = score.commands
    names = ("late", "unanswered", "lost", "held", "refused", "first_problem", "compared")
    p50, p99, worst = counts.quantiles()
    return {
        "faults": dataclasses.asdict(score.faults),
        **score.outcome.model_dump(),
        "seconds": score.seconds,
        "steps": _count_steps(score),
        "response_s": {"p50": p50, "p99": p99, "worst": worst},
        **{name: getattr(counts, name) for name in names},
        "robot_late_s": {
            name: float(np.quantile(counts.robot_late_s, q)) for name, q in (("p99", 0.99), ("worst", 1.0))
        }
        if counts.robot_late_s
        else None,
        "differences": [dataclasses.asdict(difference) for difference in counts.differences],
        "episodes": [
            {"seed": result.seed, "success": result.success, "return": result.total_reward, "length": result.length}
            for result in score.episodes
        ],
    }
