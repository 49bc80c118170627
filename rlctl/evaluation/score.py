"""The score of a policy in a few numbers, as a shipped policy carries it."""

from __future__ import annotations

import dataclasses

from rlctl.evaluation.episode_statistics import mean_interval
from rlctl.evaluation.evaluate import run_evaluation
from rlctl.evaluation.request import EvalRequest
from rlctl.policy.shipped import MeasuredScore


def measure_score(request: EvalRequest) -> MeasuredScore:
    """Play the episodes of a request and summarise them, with how much actions change."""
    evaluation = run_evaluation(dataclasses.replace(request, measure_actions=True))
    results = [episode.result for episode in evaluation.played]
    limit = evaluation.max_steps
    return MeasuredScore(
        episodes=len(results),
        seed=evaluation.seed,
        mean_return=evaluation.returns.mean,
        return_interval=mean_interval([result.total_reward for result in results]),
        success=evaluation.success_rate,
        success_interval=evaluation.success_interval,
        mean_length=evaluation.lengths.mean,
        ended_early=None if limit is None else sum(result.length < limit for result in results) / len(results),
        action_change=evaluation.action_change or 0.0,
    )


def describe_score(score: MeasuredScore) -> str:
    """Return `success 100.0 % (96.3 to 100.0), return 96.7 (95.1 to 98.2), action change 0.031`."""
    parts = []
    if score.success is not None and score.success_interval is not None:
        low, high = (100 * bound for bound in score.success_interval)
        parts.append(f"success {score.success:.1%} ({low:.1f} to {high:.1f})")
    low, high = score.return_interval
    parts.append(f"return {score.mean_return:.4g} ({low:.4g} to {high:.4g})")
    if score.ended_early is not None:
        parts.append(f"{score.ended_early:.0%} ended early")
    return ", ".join([*parts, f"action change {score.action_change:.3f}"])
