"""Chooses episodes by their outcome: the worst, the best, or failures."""

from collections.abc import Sequence

from rlctl import output
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.evaluation.players import Baseline, LoadedPolicy
from rlctl.play.collect import play_episodes
from rlctl.play.messages import EpisodeResult
from rlctl.play.seeds import Stream, episode_seeds
from rlctl.play.workers import Workers, count_envs
from rlctl.replaying.replay_request import Choice


def choose_episodes(
    policy: LoadedPolicy | Baseline, spec: EnvSpec, episodes: int, seed: int, choice: Choice
) -> tuple[list[EpisodeResult], str]:
    """Play the episodes that `rlctl eval` plays; return the chosen ones, the worst or best first, and a description."""
    seeds = episode_seeds(seed, Stream.EVAL, episodes)
    progress = output.show_progress("playing episodes to choose from", episodes, "episodes")
    with Workers(spec, count_envs(spec, episodes)) as workers, progress as show:
        policy.give_to(workers)
        results = [episode.result for episode in play_episodes(workers, seeds, watch=show)]
    chosen = select(results, choice)
    return chosen, f"{_describe_choice(results, choice.kind, len(chosen))} (seed {seed})"


def _describe_choice(results: Sequence[EpisodeResult], kind: str, count: int) -> str:
    episodes = output.format_count(len(results), "episode")
    if kind == "failures":
        failures = output.format_count(sum(not result.success for result in results), "failure")
        return f"{count} of {failures} among {episodes}" if count else f"nothing to replay: no failure among {episodes}"
    known = [result.success for result in results if result.success is not None]
    successes = f", of which {sum(known)} succeeded" if known else ""
    return f"the {f'{count} ' if count > 1 else ''}{kind} of {episodes}{successes}"


def select(results: Sequence[EpisodeResult], choice: Choice) -> list[EpisodeResult]:
    """Return the results of the chosen episodes, the worst or best first.

    Raises `UsageError` for failures where the task reports no success.
    """
    if choice.kind == "failures" and any(result.success is None for result in results):
        raise UsageError(
            f"--failures: this task reports no success; use --worst {choice.count}, which selects by return"
        )
    candidates = [result for result in results if choice.kind != "failures" or not result.success]
    candidates.sort(key=lambda result: (bool(result.success), result.total_reward), reverse=choice.kind == "best")
    return candidates[: choice.count]
