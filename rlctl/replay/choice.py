"""Which episodes to replay: the worst, the best or the failed ones of many that workers play first."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

from rlctl.env_spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.eval.evaluate import LoadedPolicy
from rlctl.rollout.collect import play_episodes
from rlctl.rollout.messages import EpisodeResult
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.rollout.workers import Workers, available_cores


@dataclasses.dataclass(frozen=True)
class Choice:
    """Episodes by outcome: by success where the task reports it, then by return."""

    kind: Literal["worst", "best", "failures"]
    count: int


def choose_episodes(
    policy: LoadedPolicy, spec: EnvSpec, episodes: int, seed: int, choice: Choice
) -> tuple[list[EpisodeResult], str]:
    """Play the episodes that `rlctl eval` plays and return those chosen, the most extreme first, and what they are.

    Raises `UsageError` for failures where the task reports no success.
    """
    seeds = episode_seeds(seed, Stream.EVAL, episodes)
    with Workers(spec, min(episodes, available_cores())) as workers:
        policy.give_to(workers)
        results = [episode.result for episode in play_episodes(workers, seeds)]
    chosen = select(results, choice)
    known = [result.success for result in results if result.success is not None]
    successes = f", {sum(known)} of which succeeded" if known else ""
    if not chosen:
        return chosen, f"no failure among {episodes} episodes (seed {seed}): nothing to replay"
    return chosen, f"the {len(chosen)} {choice.kind} of {episodes} episodes (seed {seed}){successes}"


def select(results: Sequence[EpisodeResult], choice: Choice) -> list[EpisodeResult]:
    """Return the results of the chosen episodes, the most extreme first."""
    if choice.kind == "failures" and any(result.success is None for result in results):
        raise UsageError(f"--failures: this task reports no success; --worst {choice.count} goes by the return")
    left = [result for result in results if choice.kind != "failures" or not result.success]
    left.sort(key=lambda result: (bool(result.success), result.total_reward), reverse=choice.kind == "best")
    return left[: choice.count]
