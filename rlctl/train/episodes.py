"""Which evaluation episodes a training keeps: the first and the worst of each evaluation."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np

from rlctl.env_spec import EnvSpec
from rlctl.errors import ArtifactError, EpisodeFailed, RlctlError
from rlctl.rollout.collect import Episode
from rlctl.run import files
from rlctl.run.directory import RunDirectory
from rlctl.run.env_info import EnvInfo
from rlctl.run.episode import EpisodeInfo, RecordedEpisode, load_episode, save_episode
from rlctl.run.policy import collect_versions
from rlctl.train.saving import Saver

_LATEST = 1000
_POLICY = "training step "


class EpisodeKeeper:
    """Writes episodes into a run folder; `spec` and `info` are what evaluations are played in."""

    def __init__(self, saver: Saver, spec: EnvSpec, info: EnvInfo) -> None:
        self.run = saver.run
        self._saver = saver
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

    def record(self, count: int) -> list[Path]:
        """Write the last `count` episodes of the last evaluation, and recordings of them; return these."""
        recordings = []
        for episode in list(self._latest)[-count:] if count else []:
            from rlctl.replay.reproduce import record_episode

            path = self._write(episode)
            recording = path.with_suffix(".rrd")
            title = f"{self.run.path.name} / episode {path.stem}"
            record_episode(episode, recording, title=title, several=count > 1)
            recordings.append(recording)
        return recordings

    def keep_failed(self, error: RlctlError, spec: EnvSpec, evaluated_at: int | None = None) -> RlctlError:
        """Write the actions of an episode that failed, if they are known; return the error, with the file in its hint.

        It was of environments of `spec`, in training or in the evaluation at a step.
        """
        if not isinstance(error, EpisodeFailed) or error.actions is None:
            return error
        info = EpisodeInfo(
            spec=spec,
            seed=error.seed,
            policy="training" if evaluated_at is None else f"{_POLICY}{evaluated_at}",
            total_reward=0.0,
            versions=collect_versions(),
            failure=str(error).partition("\n")[0],
        )
        nothing = np.zeros(0)
        # Of a reset that failed there is no action to take the shape from.
        actions = np.asarray(error.actions).reshape(-1, *(self.info.spaces()[1].shape or ()))
        episode = RecordedEpisode(info, actions, nothing, nothing, nothing.reshape(0, 0))
        files: list[Path] = []
        self._saver.attempt("failed episode", lambda: files.append(self._write(episode)))
        return error.with_hint(f"to reproduce it: rlctl replay {files[0]}") if files else error

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
