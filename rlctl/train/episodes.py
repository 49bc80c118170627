"""Which evaluation episodes a training keeps: the first and the worst of each evaluation."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np

from rlctl.env_spec import EnvSpec
from rlctl.errors import ArtifactError, EpisodeFailed
from rlctl.rollout.collect import Episode
from rlctl.run import files
from rlctl.run.directory import RunDirectory
from rlctl.run.env_info import EnvInfo
from rlctl.run.episode import EpisodeInfo, RecordedEpisode, load_episode, save_episode
from rlctl.run.policy import collect_versions

_LATEST = 1000
_POLICY = "training step "


class EpisodeKeeper:
    """Writes episodes into a run folder."""

    def __init__(self, run: RunDirectory, spec: EnvSpec, info: EnvInfo) -> None:
        self.run = run
        self.spec = spec
        self.info = info
        self._latest: deque[RecordedEpisode] = deque(maxlen=_LATEST)

    def keep(self, episodes: list[Episode], steps: int) -> None:
        """Write the first and the worst of an evaluation; remember all of it for `latest`."""
        recorded = [self._recorded(episode, steps) for episode in episodes]
        self._latest = deque(recorded, maxlen=_LATEST)
        worst = min(
            range(len(episodes)), key=lambda i: (episodes[i].result.success is True, episodes[i].result.total_reward)
        )
        for index in dict.fromkeys((0, worst)):
            self._write(recorded[index])

    def latest(self, count: int) -> list[tuple[Path, RecordedEpisode]]:
        """Write the last `count` episodes of the last evaluation, and return them with their files."""
        return [(self._write(episode), episode) for episode in list(self._latest)[-count:]] if count else []

    def keep_failed(self, spec: EnvSpec, error: EpisodeFailed, evaluated_at: int | None = None) -> Path:
        """Write `error.actions`, of an episode in which an environment failed; return the file."""
        policy = "training" if evaluated_at is None else f"{_POLICY}{evaluated_at}"
        failure = str(error).partition("\n")[0]
        info = EpisodeInfo(
            spec=spec, seed=error.seed, policy=policy, total_reward=0.0, versions=collect_versions(), failure=failure
        )
        nothing = np.zeros(0)
        # Of a reset that failed there is no action to take the shape from.
        actions = np.asarray(error.actions).reshape(-1, *(self.info.spaces()[1].shape or ()))
        return self._write(RecordedEpisode(info, actions, nothing, nothing, nothing.reshape(0, 0)))

    def _write(self, episode: RecordedEpisode) -> Path:
        path = self.run.episode_file(self.run.next_episode_number())
        save_episode(path, episode)
        return path

    def _recorded(self, episode: Episode, steps: int) -> RecordedEpisode:
        trajectory = episode.trajectory
        assert trajectory is not None  # evaluations record
        spec = self.spec
        info = EpisodeInfo(
            spec=spec,
            seed=episode.seed,
            policy=f"{_POLICY}{steps}",
            success=episode.result.success,
            total_reward=episode.result.total_reward,
            term_names=list(self.info.reward_weights),
            versions=collect_versions(),
        )
        return RecordedEpisode(info, trajectory.actions, trajectory.observations, trajectory.rewards, trajectory.terms)


def remove_after(run: RunDirectory, steps: int) -> None:
    """Remove the episodes of evaluations after a training step: a resumed run repeats them."""
    for file in run.episodes.glob("*.npz"):
        try:
            policy = load_episode(file).info.policy
        except ArtifactError:
            continue  # not one that a training has written whole
        step = policy.removeprefix(_POLICY)
        if policy.startswith(_POLICY) and step.isdigit() and int(step) > steps:
            files.remove(file)
