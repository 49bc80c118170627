"""The worlds of a `BatchTask` in a worker: they play their segments in lockstep, with one forward pass per step."""

from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import SINGLE
from rlctl.play import messages
from rlctl.play.messages import EpisodeResult, FailedInEpisode
from rlctl.play.seeds import list_training_seeds
from rlctl.play.shared_arrays import CRITIC, SharedArrays
from rlctl.policy.actor import Actor, Rows
from rlctl.printed_lines import print_line
from rlctl.task.batch_env import BatchEnv, BatchStep

Worlds = NDArray[np.int64]


class BatchEpisodes:
    """The running episodes of a `BatchEnv`; world 0 is the environment `first` of all."""

    def __init__(self, env: BatchEnv, first: int) -> None:
        self.env, self._first = env, first
        count = env.worlds
        self.seeds = np.full(count, -1, np.int64)
        self._return, self._time = np.zeros(count), np.zeros((count, 2))  # of policy and environment [s]
        self._sums = np.zeros((count, len(env.weights)))
        self._deepest = np.full(count, np.nan)  # how far bodies overlapped at most [m]; NaN: it was not measured
        self._weights = np.array([*env.weights.values()])
        self.teacher: Actor | None = None

    def begin(self, arrays: SharedArrays, worlds: Worlds, seeds: Sequence[int]) -> NDArray[np.float32]:
        """Begin episodes; return their first observations, which are written into the shared arrays too."""
        self.seeds[worlds] = seeds
        if self.teacher is not None:
            self.teacher.begin(self._rows(worlds))
        self._return[worlds] = 0.0
        self._sums[worlds] = 0.0
        self._time[worlds] = 0.0
        self._deepest[worlds] = np.nan
        inside = arrays.inside[self._first : self._first + self.env.worlds]
        inside[worlds] = np.stack(
            [self.seeds[worlds], np.zeros(len(worlds), np.int64), np.full(len(worlds), -1)], axis=1
        )
        try:
            first = self.env.reset(worlds, [int(seed) for seed in seeds], arrays.level[self._first + worlds])
        except BaseException as error:  # a plugin may raise anything, SystemExit too
            self._fail(error, int(worlds[0]))
        arrays.observation[SINGLE][self._first + worlds] = first
        self._show_critic(arrays.observation, worlds, self._first + worlds)
        inside[worlds, 1] = -1
        return first

    def replay(self, arrays: SharedArrays, asked: messages.BeginEpisodes) -> list[int]:
        """Begin episodes and replay their actions; return the environments whose episode ended or failed."""
        left: list[int] = []
        episodes = dict(asked.episodes)
        while episodes:
            try:
                return left + self._replay(arrays, episodes)
            except FailedInEpisode as failure:
                if not asked.may_fail:
                    raise
                del episodes[failure.where[0]]  # the others begin again, without this one
                left.append(failure.where[0])
                print_line(f"{failure} when it was replayed")
        return left

    def _replay(self, arrays: SharedArrays, episodes: Mapping[int, tuple[int, NDArray[np.generic]]]) -> list[int]:
        """Take the recorded actions in lockstep; return the environments whose episode ended."""
        envs = np.array([*episodes], np.int64) - self._first
        self.begin(arrays, envs, [seed for seed, _ in episodes.values()])
        actions = {env - self._first: taken for env, (_, taken) in episodes.items()}
        left: list[int] = []
        running, longest = envs, max(len(taken) for taken in actions.values())
        for step in range(longest):
            running = np.array([env for env in running.tolist() if step < len(actions[env])], np.int64)
            if not len(running):
                break
            if self.teacher is not None:
                self._teach(self.teacher, running)  # it may have a recurrent state
            result = self._step(np.stack([actions[env][step] for env in running.tolist()]), running)
            arrays.observation[SINGLE][self._first + running] = result.observation
            self._show_critic(arrays.observation, running, self._first + running)
            ended = result.terminated | result.truncated
            left += running[ended].tolist()
            running = running[~ended]
        return [env + self._first for env in left]

    def _step(self, action: NDArray[Any], worlds: Worlds) -> BatchStep:
        try:
            result = self.env.step(action, None if len(worlds) == self.env.worlds else worlds)
        except BaseException as error:  # a plugin may raise anything, SystemExit too
            self._fail(error, int(worlds[0]))
        self._return[worlds] += result.reward
        self._sums[worlds] += result.terms
        return result

    def _show_critic(self, target: Mapping[str, NDArray[Any]], worlds: Worlds, index: Any) -> None:
        """Write what only the critic sees now into rows of arrays."""
        if CRITIC not in target:
            return
        try:
            target[CRITIC][index] = self.env.observe_privileged(worlds)
        except BaseException as error:  # a plugin may raise anything, SystemExit too
            self._fail(error, int(worlds[0]))

    def _fail(self, error: BaseException, world: int) -> NoReturn:
        world = getattr(error, "world", world)  # of `WorldFailed` and `in_world`
        raise FailedInEpisode(self._first + world, int(self.seeds[world]), int(self.env.step_of[world])) from error

    def _rows(self, worlds: Worlds) -> Rows:
        return Rows(worlds, self.seeds[worlds], self.env.step_of[worlds])

    def _teach(self, teacher: Actor, worlds: Worlds) -> NDArray[Any]:
        """Return the teacher's actions in the present step of some worlds, shape (k, ...)."""
        return teacher.act(self.env.for_teacher[worlds], self._rows(worlds))[1]

    def play(
        self,
        arrays: SharedArrays,
        asked: messages.Play,
        actor: Actor,
        states: NDArray[np.float32] | None,
    ) -> list[EpisodeResult]:
        """Play a segment in the environments of `asked.begin`; return the episodes that ended.

        `states` are the recurrent states that the main process sees, shape (worlds, 2, layers, hidden).
        """
        envs = np.array(sorted(asked.begin), np.int64)
        worlds, seeds = envs - self._first, [asked.begin[int(env)] for env in envs]
        new = np.array([seed >= 0 for seed in seeds])
        if new.any():
            self.begin(arrays, worlds[new], [seed for seed in seeds if seed >= 0])
            actor.begin(self._rows(worlds[new]))
            if states is not None:
                states[worlds[new]] = 0.0
        played = worlds
        following = {
            env: list_training_seeds(asked.run_seed, env, number) for env, number in asked.next_episodes.items()
        }
        segment, now = arrays.segment, arrays.segment.observation[SINGLE]
        for key, rows in segment.observation.items():
            rows[envs, 0] = arrays.observation[key][envs]
        inside = arrays.inside
        inside[envs, 0] = self.seeds[worlds]
        if states is not None and actor.state is not None:
            actor.state[played] = states[played]
        actor.prepare()
        ended: list[EpisodeResult] = []
        for row in range(asked.steps):
            began = perf_counter()
            stored, action = self._choose(actor, now[envs, row], worlds)
            if self.teacher is not None:
                segment.label[envs, row] = label = self._teach(self.teacher, worlds)
                taught = np.isin(envs, asked.taught)
                stored[taught], action[taught] = label.reshape(stored.shape)[taught], label[taught]
            acted = perf_counter()
            segment.stored[envs, row], segment.action[envs, row] = stored, action
            inside[envs, 1], inside[envs, 2] = self.env.step_of[worlds] + 1, row
            result = self._step(segment.action[envs, row], worlds)
            self._time[worlds] += (acted - began) / len(worlds), (perf_counter() - acted) / len(worlds)
            segment.reward[envs, row] = result.reward
            segment.terminated[envs, row], segment.truncated[envs, row] = result.terminated, result.truncated
            if asked.record:
                segment.terms[envs, row] = result.terms
            now[envs, row + 1] = result.observation
            self._show_critic(segment.observation, worlds, (envs, row + 1))
            self._measure_contacts(worlds[np.isin(envs, asked.contacts)])
            done = result.terminated | result.truncated
            if done.any():
                for k in np.flatnonzero(done).tolist():
                    world = int(worlds[k])
                    ended.append(self._summarize(k, world, row, result, actor.report(world)))
                for key, rows in segment.final.items():
                    rows[envs[done], row] = segment.observation[key][envs[done], row + 1]
                if following:
                    fresh = [next(following[int(env)]) for env in envs[done]]
                    if asked.levels is not None:
                        for last in ended[-len(fresh) :]:
                            level = float(arrays.level[last.env])
                            arrays.level[last.env] = asked.levels.follow(level, last.success)
                    self.begin(arrays, worlds[done], fresh)
                    for key, rows in segment.observation.items():
                        rows[envs[done], row + 1] = arrays.observation[key][envs[done]]
                    actor.begin(self._rows(worlds[done]))
                else:
                    arrays.observation[SINGLE][envs[done]] = result.observation[done]
                    envs, worlds = envs[~done], worlds[~done]
                    if not len(envs):
                        break
        for key, rows in segment.observation.items():
            arrays.observation[key][envs] = rows[envs, asked.steps]
        inside[self._first : self._first + self.env.worlds, 1] = -1
        if states is not None and actor.state is not None:
            states[played] = actor.state[played]
        return sorted(
            ended, key=lambda result: result.env
        )  # in the order of environments that play one after the other

    def _choose(self, actor: Actor, observations: NDArray[Any], worlds: Worlds) -> tuple[NDArray[Any], NDArray[Any]]:
        try:
            return actor.act(observations, self._rows(worlds))
        except BaseException as error:  # a user's function may raise anything, SystemExit too
            self._fail(error, int(worlds[0]))

    def _measure_contacts(self, worlds: Worlds) -> None:
        for world in worlds.tolist():
            self._deepest[world] = np.fmax(self._deepest[world], self.env.sim.one(world).deepest_contact)

    def _summarize(self, k: int, world: int, row: int, result: BatchStep, report: dict[str, Any]) -> EpisodeResult:
        steps, sums = int(self.env.step_of[world]), self._sums[world]
        names = list(self.env.weights)
        acting, stepping = self._time[world].tolist()
        last = dict(zip(names, result.terms[k].tolist(), strict=True))
        return EpisodeResult(
            self._first + world,
            int(self.seeds[world]),
            float(self._return[world]),
            steps,
            None if result.success is None else bool(result.success[k]),
            dict(zip(names, (sums * self._weights).tolist(), strict=True)),
            last.get("distance"),
            row,
            report,
            None if np.isnan(self._deepest[world]) else float(self._deepest[world]),
            acting=acting / max(acting + stepping, 1e-9),
            metrics={name: float(sums[index]) / steps for index, name in enumerate(names) if not self._weights[index]},
            drawn=dict(self.env.drawn[world]),
        )

    def close(self) -> None:
        """End the simulation."""
        self.env.close()
