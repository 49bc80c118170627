"""Evaluation episodes of a training: the same each time; the first and the worst are saved."""

import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.errors import EpisodeFailed, RlctlError
from rlctl.policy.file import PolicyFile
from rlctl.policy.players.player import Exploration
from rlctl.recipe.recipe import Recipe
from rlctl.rollout.collect import Episode, play_episodes
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.rollout.workers import Workers
from rlctl.run.episode import EpisodeInfo, RecordedEpisode, save_episode
from rlctl.training.checkpoints import STEP_LABEL, Checkpoints
from rlctl.version import collect_versions


class EvaluationEpisodes:
    """Plays the evaluation episodes of a run, and saves some of them, without any effect on the training.

    `goal` describes the environments of the evaluations.
    """

    def __init__(
        self, recipe: Recipe, make_workers: Callable[[], Workers], checkpoints: Checkpoints, goal: EnvInfo
    ) -> None:
        self._recipe = recipe
        self._make_workers = make_workers
        self._checkpoints = checkpoints
        self._goal = goal
        # They build their environments during the first updates, which leave a core idle.
        self._workers: Workers | None = make_workers()
        self._spec = self._workers.spec
        self._latest: list[RecordedEpisode] = []

    def play(self, policy: PolicyFile, check: Callable[[], None], *, unseen: int | None = None) -> list[Episode]:
        """Play the episodes of every evaluation, or `unseen` new ones; return them.

        `check` is called several times a second and may raise to stop. Raises `TaskError` if an environment fails;
        the next call uses new environments.
        """
        settings = self._recipe.eval
        workers = self._workers = self._workers or self._make_workers()
        usual = settings.episodes
        seeds = episode_seeds(self._recipe.seed, Stream.EVAL_IN_TRAINING, usual + (unseen or 0))
        seeds = seeds[:usual] if unseen is None else seeds[usual:]
        try:
            workers.set_policy(policy)
            exploration = Exploration(stochastic=not settings.deterministic)
            return play_episodes(workers, seeds, exploration, record=True, watch=lambda _: check())
        except Exception:
            self.close()
            raise

    def close(self) -> None:
        """Stop the environments' processes."""
        if self._workers is not None:
            self._workers.close()
        self._workers = None

    def keep(self, episodes: list[Episode], steps: int) -> None:
        """Save the first and the worst episode of an evaluation; remember all for `record`."""
        policy = f"{STEP_LABEL}{steps}"
        self._latest = recorded = [episode.describe(self._spec, self._goal, policy) for episode in episodes]
        worst = min(
            range(len(episodes)), key=lambda i: (episodes[i].result.success is True, episodes[i].result.total_reward)
        )
        for index in dict.fromkeys((0, worst)):
            self._write(recorded[index])

    def record(self, count: int) -> list[Path]:
        """Save the last `count` episodes of the last evaluation with recordings; return the recordings' paths."""
        recordings = []
        for episode in self._latest[-count:] if count else []:
            from rlctl.replaying.reproduce import record_episode

            path = self._write(episode)
            recording = path.with_suffix(".rrd")
            title = f"{self._checkpoints.run.path.name} / episode {path.stem}"
            record_episode(episode, recording, title=title, several=count > 1)
            recordings.append(recording)
        return recordings

    def keep_failed(self, error: RlctlError, spec: EnvSpec, evaluated_at: int | None = None) -> RlctlError:
        """Save the actions of a failed episode, if known; return the error with a hint that names the file.

        The episode was played in `spec`, in training or, at step `evaluated_at`, in an evaluation.
        """
        if not isinstance(error, EpisodeFailed) or error.actions is None:
            return error
        info = EpisodeInfo(
            spec=spec,
            seed=error.seed,
            policy="training" if evaluated_at is None else f"{STEP_LABEL}{evaluated_at}",
            total_reward=0.0,
            versions=collect_versions(),
            failure=str(error).partition("\n")[0],
        )
        nothing = np.zeros(0)
        # If the reset failed there are no actions with a shape.
        actions = np.asarray(error.actions).reshape(-1, *(self._goal.spaces()[1].shape or ()))
        episode = RecordedEpisode(actions, nothing, nothing, nothing.reshape(0, 0), info)
        written: list[Path] = []
        self._checkpoints.attempt("failed episode", lambda: written.append(self._write(episode)))
        return error.with_hint(f"to reproduce it: rlctl replay {shlex.quote(str(written[0]))}") if written else error

    def _write(self, episode: RecordedEpisode) -> Path:
        run = self._checkpoints.run
        path = run.episode_file(run.next_episode_number())
        save_episode(path, episode)
        return path
