"""Plays the same episodes in one setting of an environment after the other."""

from __future__ import annotations

from rlctl.environments.registry import is_task
from rlctl.environments.spec import EnvSpec
from rlctl.evaluation.evaluate import LoadedPolicy
from rlctl.evaluation.request import EvalRequest
from rlctl.policy.players.player import Exploration
from rlctl.rollout.collect import play_episodes
from rlctl.rollout.messages import EpisodeResult
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.rollout.workers import Workers


class CellPlayer:
    """Plays the same episodes in one environment after the other, in workers that stay."""

    def __init__(self, workers: Workers, policy: LoadedPolicy, request: EvalRequest) -> None:
        self.workers = workers
        self._policy = policy
        self._seeds = episode_seeds(request.seed, Stream.EVAL, request.episodes)
        self._exploration = Exploration(stochastic=not request.deterministic)
        self._has_events = is_task(workers.spec.constructor())

    def play(self, spec: EnvSpec, push: dict[str, object] | None = None) -> list[EpisodeResult]:
        """Play all episodes with the events and parameters of `spec`; `push` is as in `Workers.set_events`."""
        workers = self.workers
        if (spec.parameters, spec.sim) != (workers.spec.parameters, workers.spec.sim):
            workers.rebuild(spec)
            self._policy.give_to(workers)
        if self._has_events:
            workers.set_events(spec, push)
        return [episode.result for episode in play_episodes(workers, self._seeds, self._exploration)]
