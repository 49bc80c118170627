"""Playing a list of episodes with a policy, on many environments."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rlctl import dict_spaces
from rlctl.dict_spaces import Observations
from rlctl.errors import EpisodeFailed
from rlctl.rollout.workers import EpisodeResult, Workers


class Actor(Protocol):
    """Chooses actions for several environments at once; may keep a state per row (a recurrent state)."""

    def act(self, observations: Observations, rows: NDArray[np.int64], starts: NDArray[np.bool_]) -> NDArray[Any]:
        """Return an action per observation.

        `observations` has a row per element of `rows`, the environment of each; `starts`
        marks which of them begin an episode.
        """
        ...


@dataclasses.dataclass
class Trajectory:
    """What happened in an episode of T steps."""

    observations: Observations
    """What each action was chosen from and, last, what the episode ended with: shape (T + 1, ...)."""
    actions: NDArray[Any]
    """Shape (T, ...)."""
    rewards: NDArray[np.float64]
    """Shape (T,)."""
    terms: NDArray[np.float64]
    """Raw reward terms in the order of the task's weights, shape (T, terms)."""


@dataclasses.dataclass(frozen=True)
class Episode:
    """The episode of one seed in a list: its result and, where asked for, its trajectory."""

    index: int
    seed: int
    result: EpisodeResult
    trajectory: Trajectory | None = None


def run_episodes(
    workers: Workers,
    actor: Actor,
    seeds: Sequence[int],
    *,
    record: bool = False,
    on_episode: Callable[[int], None] | None = None,
) -> list[Episode]:
    """Play an episode per seed and return them in the order of `seeds`.

    Which environment plays which episode does not matter: an episode follows from its seed and the policy alone.
    `on_episode` is called with the number of episodes done.
    """
    arrays = workers.arrays
    arrays.next_seed[:] = -1
    arrays.record[:] = record and bool(workers.info.reward_weights)  # a plain environment has no terms
    workers.reset(dict.fromkeys(range(workers.n_envs), -1))
    waiting = list(enumerate(seeds))[::-1]
    running: dict[int, int] = {}
    recorders: dict[int, _Recorder] = {}
    episodes: dict[int, Episode] = {}
    starts = np.ones(workers.n_envs, np.bool_)
    free = list(range(min(workers.n_envs, len(seeds))))
    while True:
        first = {}
        for env in free:
            if waiting:
                running[env], first[env] = waiting.pop()
                recorders[env] = _Recorder()
                starts[env] = True
        if first:
            workers.reset(first)
        if not running:
            break
        rows = np.fromiter(sorted(running), np.int64, len(running))
        observations = workers.observations(rows)
        actions = actor.act(observations, rows, starts[rows])
        arrays.action[rows] = actions
        starts[rows] = False
        try:
            ended = workers.step()
        except EpisodeFailed as error:
            if error.env in recorders and record:
                error.actions = recorders[error.env].actions(arrays.action[error.env])[: error.step]
            raise
        if record:
            for index, env in enumerate(rows.tolist()):
                recorders[env].add(dict_spaces.take_row(observations, index), actions[index], arrays, env)
        for result in ended:
            index = running.pop(result.env)
            trajectory = None
            if record:
                last = dict_spaces.take_row(workers.final_observations([result.env]), 0)
                trajectory = recorders[result.env].trajectory(last)
            episodes[index] = Episode(index, result.seed, result, trajectory)
            if on_episode:
                on_episode(len(episodes))
        free = [result.env for result in ended]
    return [episodes[index] for index in range(len(seeds))]


class _Recorder:
    def __init__(self) -> None:
        self._observations: list[Any] = []
        self._actions: list[Any] = []
        self._rewards: list[float] = []
        self._terms: list[Any] = []

    def add(self, observation: Any, action: Any, arrays: Any, env: int) -> None:
        self._observations.append(observation)
        self._actions.append(np.array(action))
        self._rewards.append(float(arrays.reward[env]))
        self._terms.append(arrays.terms[env].copy())

    def actions(self, now: Any) -> NDArray[Any]:
        """Return the actions up to `now`, that of a step that was not done."""
        return np.stack([*self._actions, np.array(now)])

    def trajectory(self, last: Any) -> Trajectory:
        steps = [*self._observations, last]
        observations = dict_spaces.stack(steps)
        return Trajectory(observations, np.stack(self._actions), np.array(self._rewards), np.stack(self._terms))
