"""Plays a list of episodes, each completely inside one worker."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import join, split
from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.errors import EpisodeFailed, TaskError
from rlctl.play.episode import EpisodeInfo, RecordedEpisode, Trajectory
from rlctl.play.messages import EpisodeResult, Play
from rlctl.play.workers import Workers
from rlctl.policy.actor import Exploration
from rlctl.version import collect_versions

_CONTACTS_MEASURED = 10  # the first recorded episodes, in which contacts are measured; it takes about 3 % of a step
MOST_STEPS = 20_000  # steps after which an episode without a time limit is an error: it may never end
MOST_ELEMENTS = 200  # of a part of the first observation that is kept with an episode; pictures have more
_SEGMENT = 1000  # steps after which the main process copies the recorded part of a long episode


@dataclasses.dataclass(frozen=True)
class Episode:
    """The episode of one seed in a list: its result and, where asked for, its trajectory."""

    result: EpisodeResult
    trajectory: Trajectory | None = None
    terminated: bool = False  # whether its last step terminated it; else it was truncated
    first: dict[str, NDArray[Any]] = dataclasses.field(default_factory=dict)
    """Its first observation, by key, without the parts of more than `MOST_ELEMENTS`."""

    @property
    def recorded(self) -> Trajectory:
        """The trajectory of an episode that was recorded."""
        assert self.trajectory is not None
        return self.trajectory

    def describe(self, spec: EnvSpec, env: EnvInfo, policy: str) -> RecordedEpisode:
        """Return the recorded episode in the form of a file; `policy` is the policy's name, for people."""
        info = EpisodeInfo(
            spec=spec,
            seed=self.result.seed,
            policy=policy,
            success=self.result.success,
            total_reward=self.result.total_reward,
            term_names=list(env.reward_weights),
            versions=collect_versions(),
        )
        return RecordedEpisode(**vars(self.recorded), info=info)


def play_episodes(
    workers: Workers,
    seeds: Sequence[int],
    exploration: Exploration = Exploration(),  # noqa: B008 (it cannot change)
    *,
    record: bool = False,
    taught: bool = False,
    watch: Callable[[int], None] = lambda done: None,
    check: Callable[[EpisodeResult], None] = lambda result: None,
) -> list[Episode]:
    """Play an episode per seed with the workers' policy and return them in the order of `seeds`.

    Each worker plays in its first environment, or in all worlds of a `BatchTask`. An episode depends on its seed and
    the policy only, not on the worker. With `taught` the workers' teacher acts instead of the policy.
    `watch` is called with the number of finished episodes, several times a second, and `check` with the result of each
    episode as soon as it has ended; if one of them raises, the caller must close the workers. Raises `TaskError` if an
    environment fails, and for an episode that does not end.
    """
    steps = min(workers.info.max_steps or _SEGMENT, _SEGMENT)
    terms = record and bool(workers.info.reward_weights)  # a plain environment has no terms
    waiting = list(enumerate(seeds))[::-1]
    running: dict[int, _Recorder] = {}
    episodes: dict[int, Episode] = {}

    def play(envs: Sequence[int]) -> None:
        """Continue the episodes of a worker's environments, or begin the next ones in those that have none."""
        begin = {}
        for env in envs:
            if env in running:
                begin[env] = -1
            elif waiting:
                index, begin[env] = waiting.pop()
                running[env] = _Recorder(index, record)
        contacts = [env for env in begin if terms and running[env].index < _CONTACTS_MEASURED]
        if begin:
            acting = [*begin] if taught else []
            workers.start_playing(
                Play(steps, begin, exploration=exploration, record=terms, taught=acting, contacts=contacts)
            )

    for envs in workers.playable_envs:
        play(envs)
    while running:
        before = workers.playing
        try:
            results = workers.finish_playing(first=True, watch=lambda: watch(len(episodes)))
        except EpisodeFailed as error:
            if record and error.env in running:
                error.actions = running[error.env].failed_actions(workers, error)
            raise
        ended = {result.env: result for result in results}
        for worker in sorted(before - workers.playing):
            envs = workers.playable_envs[worker]
            for env in [env for env in envs if env in running]:
                result, recorder = ended.get(env), running[env]
                recorder.add(workers, env, steps if result is None else result.row + 1)
                if result is not None:
                    check(result)
                    del running[env]
                    terminated = bool(workers.arrays.segment.terminated[env, result.row])
                    episodes[recorder.index] = Episode(result, recorder.finish(), terminated, recorder.first)
                elif workers.info.max_steps is None and recorder.steps >= MOST_STEPS:
                    raise TaskError(
                        f"task {workers.spec.task!r}: the episode of seed {seeds[recorder.index]} has not ended within "
                        f"{recorder.steps:,} steps, and no time limit is known\n"
                        "wrap it in gymnasium.wrappers.TimeLimit, or return truncated=True after a number of steps"
                    )
            play(envs)
    watch(len(episodes))
    return [episodes[index] for index in range(len(seeds))]


class _Recorder:
    def __init__(self, index: int, record: bool) -> None:
        self.index = index  # index of the episode in the list
        self._record = record
        self.steps = 0  # number of recorded steps
        self._parts: list[Trajectory] = []
        self.first: dict[str, NDArray[Any]] = {}  # the observation with which the episode begins

    def add(self, workers: Workers, env: int, steps: int) -> None:
        """Copy the first steps of an environment's segment."""
        if not self.steps:
            rows = {key: every[env, 0] for key, every in workers.arrays.segment.observation.items()}
            self.first = {key: row.copy() for key, row in rows.items() if row.size <= MOST_ELEMENTS}
        self.steps += steps
        if self._record:
            segment = workers.arrays.segment
            first = 1 if self._parts else 0  # row 0 repeats the last observation of the previous segment
            observations = {key: rows[env, first : steps + 1].copy() for key, rows in segment.observation.items()}
            arrays = (segment.action, segment.reward, segment.terms)
            actions, rewards, terms = (rows[env, :steps].copy() for rows in arrays)
            self._parts.append(Trajectory(actions, observations, rewards, terms))

    def failed_actions(self, workers: Workers, error: EpisodeFailed) -> NDArray[Any]:
        """Return the actions up to and including the failed step."""
        last = workers.arrays.segment.action[error.env, : error.step - self.steps]
        return np.concatenate([*(part.actions for part in self._parts), last])

    def finish(self) -> Trajectory | None:
        """Return the whole episode; None if it was not recorded."""
        if not self._record:
            return None
        rows = [split(part.observations) for part in self._parts]
        observations = {key: np.concatenate([row[key] for row in rows]) for key in rows[0]}
        names = ("actions", "rewards", "terms")
        actions, rewards, terms = (np.concatenate([getattr(part, name) for part in self._parts]) for name in names)
        return Trajectory(actions, join(observations), rewards, terms)
