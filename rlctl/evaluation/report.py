"""What `rlctl eval` prints: one evaluation, a group of seeds, or how robust a policy is."""

import collections
from typing import Any

import numpy as np
from pydantic_core import to_jsonable_python
from rich.text import Text

from rlctl import output
from rlctl.evaluation.episode_statistics import Spread
from rlctl.evaluation.eval_request import NO_GATES, Gates, judge
from rlctl.evaluation.evaluate import Evaluation
from rlctl.evaluation.group_scores import GroupScore, SeedScore
from rlctl.evaluation.robustness import Cell, FailedCell, Outcome, PushTest, Robustness, RobustnessMap
from rlctl.evaluation.sequential import EarlyGate
from rlctl.evaluation.vary import format_command
from rlctl.policy.shipped import Interval, MeasuredScore
from rlctl.task.events.event import describe_randomization
from rlctl.version import collect_versions

_MOST_COLUMNS = 25  # of a map that is drawn
_LIKELY = (0.1, 3.0)  # measured motion per commanded motion; a slow motor is behind, but none is far ahead
_NOMINAL, _WORST = "*", "<"


def show(result: Evaluation, json: str | None, gates: Gates = NO_GATES) -> None:
    """Print the numbers, or JSON alone for `-`."""
    missed = gates.list_missed(result.success_rate, result.success_interval, result.returns.mean)
    verdict = judge("eval", missed, has_gate=gates != NO_GATES)
    if output.present(as_json(result) | verdict | {"gates": vars(gates)}, json):
        return
    out, info = output.out(), result.policy
    mode = "" if result.deterministic else ", sampled actions"
    trained = "" if info is None else f" ({info.algo}, step {info.training_steps:,})"
    out.print(f"{result.spec.task}: {'policy ' if info is None else ''}{result.name}{trained}")
    episodes = output.format_count(len(result.played), "episode")
    settings = f"seed {result.seed}{mode}", result.spec.engine_title, describe_randomization(result.events)
    out.print(", ".join(filter(None, [episodes, *settings])))
    if result.spec.stage and info is not None:
        out.print(f"stage {result.spec.stage} of {len(info.stages)}")
    if result.success_rate is not None and result.success_interval is not None:
        low, high = result.success_interval
        out.print(f"success rate {result.success_rate:.1%}  (95 % interval {low:.1%} to {high:.1%})")
    if result.return_interval is not None:
        interval = _format_interval(result.return_interval, ".4g")
        out.print(f"mean return {result.returns.mean:.4g}  (95 % interval {interval})")
    if result.early is not None:
        out.print(_format_decision(result, result.early))
    for pattern in result.failure_patterns:
        out.print(f"  {pattern}")
    rows = [("return", *_format_spread(result.returns)), ("length", *_format_spread(result.lengths))]
    if result.final_distance is not None:
        rows.append(("final distance", *_format_spread(result.final_distance)))
    rows += [(f"term {name}", f"{mean:.4g}") for name, mean in result.terms.items() if name not in result.metrics]
    rows += [(f"metric {name}, per step", f"{mean:.4g}") for name, mean in result.metrics.items()]
    output.print_table(("", "mean", "IQM", "std", "min", "max"), rows, left=("",))
    reports = [episode.result.report for episode in result.played]
    if stopped := sum(report.get("not_running", 0) for report in reports):
        answers = sum(len(report["round_trips_s"]) for report in reports)
        out.print(f"for {stopped:,} of {answers:,} answers the server held or stopped instead of running the policy")
    if result.unlimited is not None:
        _show_limits(result, result.unlimited)


def _format_decision(result: Evaluation, early: EarlyGate) -> str:
    if result.end:
        return f"decided after {len(result.played)} of {result.planned} episodes: {result.end}"
    instead = "so the gate is missed" if early.on_lower_end else "so the rate itself is compared with it"
    return f"not decided after {len(result.played)} episodes: {early.rate:g} is in the interval, {instead}"


def _show_limits(result: Evaluation, unlimited: Evaluation) -> None:
    out = output.out()
    without, limited = unlimited.success_rate, result.success_rate
    success = ""
    if without is not None and limited is not None:
        success = f"success rate {without:.1%} without them, {limited:.1%} with them; "
    returns = f"return {unlimited.returns.mean:.4g} without them, {result.returns.mean:.4g} with them"
    out.print(f"limits of {result.limited_by}: {success}{returns}")
    steps = sum(episode.result.length for episode in result.played)
    measured, commanded = np.sum([episode.result.report["moved"] for episode in result.played], axis=0)
    if commanded and not _LIKELY[0] < measured / commanded < _LIKELY[1]:
        out.print(
            f"warning: the joints moved {measured / commanded:.2g} times as far as commanded: check scale in the limits"
        )
    rows = [(name, f"{1000 * count / steps:.4g}") for name, count in count_interventions(result).most_common()]
    if rows:
        output.print_table(("limit", "per 1,000 steps"), rows, left=("limit",))
    else:
        out.print("no limit acted")


def count_interventions(result: Evaluation) -> collections.Counter[str]:
    """Return how often each limit acted and each fault occurred, over all episodes."""
    counts: collections.Counter[str] = collections.Counter()
    for episode in result.played:
        counts.update(episode.result.report.get("interventions", {}))
    return counts


def _format_spread(spread: Spread) -> tuple[str, ...]:
    return tuple(f"{value:.4g}" for value in (spread.mean, spread.iqm, spread.std, spread.min, spread.max))


def as_json(result: Evaluation) -> dict[str, Any]:
    """Return the result as plain data."""
    info, policy = result.policy, {"baseline": result.name}
    if info is not None:
        policy = {"file": result.name, **info.model_dump(include={"algo", "training_steps", "versions"})}
    content: dict[str, Any] = {
        "task": {"name": result.spec.task, "parameters": result.spec.parameters},
        "sim": str(result.spec.resolve().sim) or None,
        "policy": policy,
        "versions": collect_versions(),
        "randomized": any(result.events.values()),
        "events": result.events,
        "seed": result.seed,
        "deterministic": result.deterministic,
        "success_rate": result.success_rate,
        "success_interval": result.success_interval,
        "interval": "Clopper-Pearson, 95 %" if result.early is None else "valid at any time, 95 %",
        "planned_episodes": result.planned,
        "end": result.end or "all episodes were played",
        "return": result.returns,
        "return_interval": result.return_interval,
        "length": result.lengths,
        "terms": result.terms,
        "metrics": result.metrics,
        "final_distance": result.final_distance,
        "failure_patterns": result.failure_patterns,
        "episodes": result.rows(),
    }
    if result.spec.stage:
        content["stage"] = result.spec.stage
    if (unlimited := result.unlimited) is not None:
        content["limits"] = {
            "file": result.limited_by,
            "success_rate_without": unlimited.success_rate,
            "return_without": unlimited.returns,
            "interventions": count_interventions(result),
        }
    return dict(to_jsonable_python(content))


def describe_score(score: MeasuredScore) -> str:
    """Return `success 100.0% (96.3% to 100.0%), return 96.7 (95.1 to 98.2), action change 0.031`."""
    early = "" if score.ended_early is None else f", {score.ended_early:.0%} ended early"
    return f"{_format_outcome(score)}{early}, action change {score.action_change:.3f}"


def _format_outcome(outcome: Outcome | MeasuredScore) -> str:
    rate = outcome.success if isinstance(outcome, MeasuredScore) else outcome.success_rate
    success = "" if rate is None else f"success {rate:.1%} ({_format_interval(outcome.success_interval, '.1%')}), "
    return f"{success}return {outcome.mean_return:.4g} ({_format_interval(outcome.return_interval, '.4g')})"


def _format_interval(interval: Interval | None, form: str) -> str:
    return "-" if interval is None else f"{interval[0]:{form}} to {interval[1]:{form}}"


def show_group(result: GroupScore, json: str | None) -> None:
    """Print a row per seed, then mean, IQM and standard deviation; or JSON alone for `-`."""
    if output.present(result.as_json(), json):
        return
    out = output.out()
    scores = [seed.score for seed in result.seeds if seed.score is not None]
    episodes = f", {output.format_count(scores[0].episodes, 'episode')} each, seed {scores[0].seed}" if scores else ""
    out.print(f"{result.group.task}: {result.group.path}, {output.format_count(len(result.seeds), 'seed')}{episodes}")
    success, returns = result.spread("success"), result.spread("mean_return")
    rows = [_list_cells(seed) for seed in result.seeds]
    for label in ("mean", "IQM", "std"):
        rate, value = (None if spread is None else getattr(spread, label.lower()) for spread in (success, returns))
        rows.append((label, "-" if rate is None else f"{rate:.1%}", "-" if value is None else f"{value:.4g}"))
    output.print_table(("seed", "success", "return", "steps", "seconds", ""), rows, left=("",))


def _list_cells(seed: SeedScore) -> tuple[str, ...]:
    success, mean_return = (None, None) if seed.score is None else (seed.score.success, seed.score.mean_return)
    numbers = ((success, ".1%"), (mean_return, ".4g"), (seed.steps, ","), (seed.seconds, ".0f"))
    return (str(seed.seed), *("-" if value is None else format(value, form) for value, form in numbers), seed.problem)


def show_robustness(result: Robustness, json: str | None) -> None:
    """Print the maps and the push, or JSON alone for `-`."""
    if output.present(result.model_dump(mode="json"), json):
        return
    out = output.out()
    about = "" if result.is_baseline else f" ({result.algo}, step {result.training_steps:,})"
    out.print(f"{result.task}: {result.policy_file}{about}")
    mode = "" if result.deterministic else ", sampled actions"
    episodes = output.format_count(result.episodes, "episode")
    out.print(f"{episodes} in every cell, the same seeds (seed {result.seed}){mode}")
    out.print(f"nominal: {_format_outcome(result.nominal)}")
    worst = result.find_worst()
    for varied in result.maps:
        out.print()
        _show_map(varied, worst[1] if worst else None)
    if any(varied.played for varied in result.maps):
        where, outcome = result.name_worst()
        out.print(f"\nworst: {where}: {_format_outcome(outcome)}")
    if worst is not None:
        varied, cell = worst
        out.print(f"to play only these episodes: {format_command(result, varied, cell)}")
    for line in result.list_failed():
        out.print(f"failed: {line}")
    if result.push is not None:
        out.print()
        _show_push(result.push)


def _show_map(varied: RobustnessMap, worst: Cell | None) -> None:
    if len(varied.axes) == 1:
        _show_list(varied, worst)
    elif len(varied.axes[1].values) <= _MOST_COLUMNS:
        _show_grid(varied, worst)
    else:
        names = " x ".join(axis.name for axis in varied.axes)
        output.out().print(
            f"{names}: more than {_MOST_COLUMNS} columns, too many to draw; --json FILE writes all cells"
        )


def _show_list(varied: RobustnessMap, worst: Cell | None) -> None:
    successes = ("success", "95 % interval") if varied.has_success else ()
    rows = []
    for cell in varied.cells:
        cells = [f"{cell.values[0]:g}"]
        if isinstance(cell, FailedCell):
            rows.append([*cells, *("-" for _ in successes), "-", "-", "failed"])
            continue
        if cell.success_rate is not None:
            cells += [f"{cell.success_rate:.1%}", _format_interval(cell.success_interval, ".1%")]
        cells += [f"{cell.mean_return:.4g}", _format_interval(cell.return_interval, ".4g")]
        marks = ["nominal" if cell.nominal else "", "worst" if cell is worst else ""]
        rows.append([*cells, ", ".join(filter(None, marks))])
    output.print_table((varied.axes[0].name, *successes, "return", "95 % interval", ""), rows, left=("",))


def _show_grid(varied: RobustnessMap, worst: Cell | None) -> None:
    """Print a heat map: the first axis downwards, the second across."""
    down, across = varied.axes
    cells = iter(zip(varied.cells, _color_cells(varied), strict=True))
    rows: list[list[str | Text]] = [
        [f"{value:.3g} ", *(_draw_cell(*next(cells), worst) for _ in across.values)] for value in down.values
    ]
    columns = [f"{down.name} \\ {across.name} ", *(f" {value:.3g} " for value in across.values)]
    output.print_table(columns, rows, gap="")
    out = output.out()
    marks = [f"{_NOMINAL} nominal"] if any(cell.nominal for cell in varied.cells) else []
    marks += [f"{_WORST} worst"] if any(cell is worst for cell in varied.cells) else []
    quantity = "success [%]" if varied.has_success else "mean return"
    out.print("; ".join(filter(None, (quantity, ", ".join(marks)))))


def _draw_cell(cell: Cell | FailedCell, color: str, worst: Cell | None) -> Text:
    if isinstance(cell, FailedCell):
        return Text(" failed ", style=f"black on {color}")
    text = f"{cell.mean_return:.3g}" if cell.success_rate is None else f"{100 * cell.success_rate:.0f}"
    mark = f"{_NOMINAL if cell.nominal else ''}{_WORST if cell is worst else ''}"
    return Text(f" {text}{mark or ' '}", style=f"black on {color}")


def _color_cells(varied: RobustnessMap) -> list[str]:
    """Return a colour per cell, from red over yellow to green: of success rates from 0 to 1, else of the returns."""
    returns = [cell.mean_return for cell in varied.played]
    low, size = min(returns, default=0.0), max(returns, default=0.0) - min(returns, default=0.0) or 1.0
    parts = []
    for cell in varied.cells:
        if isinstance(cell, FailedCell):
            parts.append(0.0)
        elif cell.success_rate is None:
            parts.append((cell.mean_return - low) / size)
        else:
            parts.append(cell.success_rate)
    return [f"rgb({min(255, round(510 * (1 - part)))},{min(255, round(510 * part))},80)" for part in parts]


def _show_push(push: PushTest) -> None:
    out = output.out()
    target = push.body if push.link is None else f"{push.link} of {push.body}"
    out.print(f"push on {target} in the middle of the episode, {push.duration_s:g} s, from a random direction")
    held = "success" if push.measure == "success" else "reached the time limit"
    rows = [
        (f"{level.impulse:.3g}", f"{level.impulse / push.mass:.2g}", f"{level.held:.1%}", f"{level.mean_return:.4g}")
        for level in push.levels
    ]
    output.print_table(("push [N s]", "speed change [m/s]", held, "return"), rows)
    out.print(push.verdict)
