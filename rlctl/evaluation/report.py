"""What an evaluation prints."""

from __future__ import annotations

import collections
from typing import Any

from pydantic_core import to_jsonable_python

from rlctl import output
from rlctl.environments.info import describe_randomization
from rlctl.evaluation.episode_statistics import Spread
from rlctl.evaluation.evaluate import Evaluation
from rlctl.version import collect_versions


def show(result: Evaluation, json: str | None) -> None:
    """Print the numbers, or JSON alone for `-`."""
    if output.present(as_json(result), json):
        return
    out = output.out()
    _show_head(result)
    if result.spec.stage and result.policy is not None:
        out.print(f"stage {result.spec.stage} of {len(result.policy.stages)}")
    if result.success_rate is not None and result.success_interval is not None:
        low, high = result.success_interval
        out.print(f"success rate {result.success_rate:.1%}  (95 % interval {low:.1%} to {high:.1%})")
    rows = [("return", *_format_spread(result.returns)), ("length", *_format_spread(result.lengths))]
    if result.final_distance is not None:
        rows.append(("final distance", *_format_spread(result.final_distance)))
    rows += [(f"term {name}", f"{mean:.4g}") for name, mean in result.terms.items() if name not in result.metrics]
    rows += [(f"metric {name}, per step", f"{mean:.4g}") for name, mean in result.metrics.items()]
    output.print_table(("", "mean", "IQM", "std", "min", "max"), rows, left=("",))
    reports = [episode.result.report for episode in result.played]
    if held := sum(report.get("not_running", 0) for report in reports):
        answers = sum(len(report["round_trips_s"]) for report in reports)
        out.print(f"the server was holding or stopped in {held:,} of {answers:,} answers: not the policy's own actions")
    if result.unlimited is not None:
        _show_limits(result, result.unlimited)


def _show_limits(result: Evaluation, unlimited: Evaluation) -> None:
    """Print what the limits cost, and how often each stepped in."""
    out = output.out()
    without, now = unlimited.success_rate, result.success_rate
    success = ""
    if without is not None and now is not None:
        success = f"success rate {without:.1%} without them, {now:.1%} with them; "
    returns = f"return {unlimited.returns.mean:.4g} without them, {result.returns.mean:.4g} with them"
    out.print(f"limits of {result.limited_by}: {success}{returns}")
    steps = sum(episode.result.length for episode in result.played)
    rows = [(name, f"{1000 * count / steps:.4g}") for name, count in count_interventions(result).most_common()]
    if rows:
        output.print_table(("stepped in", "per 1,000 steps"), rows, left=("stepped in",))
    else:
        out.print("they never stepped in")


def count_interventions(result: Evaluation) -> collections.Counter[str]:
    """Return how often each limit stepped in and each fault occurred, over all episodes."""
    counts: collections.Counter[str] = collections.Counter()
    for episode in result.played:
        counts.update(episode.result.report.get("interventions", {}))
    return counts


def _show_head(result: Evaluation) -> None:
    out, info = output.out(), result.policy
    mode = "" if result.deterministic else ", sampled actions"
    trained = "" if info is None else f" ({info.algo}, step {info.training_steps:,})"
    out.print(f"{result.spec.task}: {'policy ' if info is None else ''}{result.name}{trained}")
    randomization = describe_randomization(result.events)
    episodes = output.format_count(len(result.played), "episode")
    out.print(f"{episodes}, seed {result.seed}{mode}{randomization and f', {randomization}'}")


def _format_spread(spread: Spread) -> tuple[str, ...]:
    return tuple(f"{value:.4g}" for value in (spread.mean, spread.iqm, spread.std, spread.min, spread.max))


def as_json(result: Evaluation) -> dict[str, Any]:
    """Return the result as plain data."""
    info, policy = result.policy, {"baseline": result.name}
    if info is not None:
        policy = {"file": result.name, **info.model_dump(include={"algo", "training_steps", "versions"})}
    content = {
        "task": {"name": result.spec.task, "parameters": result.spec.parameters},
        "policy": policy,
        "versions": collect_versions(),
        "randomized": any(result.events.values()),
        "events": result.events,
        "seed": result.seed,
        "deterministic": result.deterministic,
        "success_rate": result.success_rate,
        "success_interval": result.success_interval,
        "return": result.returns,
        "length": result.lengths,
        "terms": result.terms,
        "metrics": result.metrics,
        "final_distance": result.final_distance,
        "episodes": [
            {
                "index": index,
                "seed": outcome.seed,
                "success": outcome.success,
                "return": outcome.total_reward,
                "length": outcome.length,
                "terms": outcome.terms,
                "metrics": outcome.metrics,
                "final_distance": outcome.final_distance,
            }
            for index, outcome in enumerate(episode.result for episode in result.played)
        ],
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
    plain: dict[str, Any] = to_jsonable_python(content)
    return plain
