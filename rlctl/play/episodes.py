"""The running episodes of the worlds of a worker; their segments are written into arrays of the main process."""

from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import SINGLE, join, split
from rlctl.errors import TaskError, describe_exception, format_plugin_traceback
from rlctl.play import messages
from rlctl.play.messages import EpisodeResult, FailedInEpisode
from rlctl.play.playing import Playing, RecordedActions, Worlds
from rlctl.play.seeds import list_training_seeds
from rlctl.play.shared_arrays import CRITIC, SharedArrays
from rlctl.policy.actor import Actor, Array, Rows
from rlctl.printed_lines import print_line
from rlctl.task.world_index import WorldIndex


class Episodes:
    """The episodes of some worlds; world 0 is the environment `first` of all, and the row `row` of actors.

    What worlds and actors raise is raised as `FailedInEpisode`, with the episode.
    """

    def __init__(
        self, worlds: Worlds, first: int, row: int = 0, *, has_critic: bool = False, teacher: Actor | None = None
    ) -> None:
        self.worlds, self.first, self.teacher = worlds, first, teacher
        self._row = row
        self._has_critic = has_critic
        self.playing = Playing(worlds)
        self.times_s = np.zeros((worlds.count, 2))  # of policy and environment in each episode [s]
        self.deepest = np.full(worlds.count, np.nan)  # how far bodies overlapped at most [m]; NaN: not measured

    @property
    def envs(self) -> range:
        """The numbers of its environments."""
        return range(self.first, self.first + self.worlds.count)

    def _fail(self, error: BaseException, world: int) -> NoReturn:
        world = getattr(error, "world", world)  # of `WorldFailed` and `in_world`
        seed, step = int(self.playing.seeds[world]), int(self.worlds.step_of[world])
        raise FailedInEpisode(self.first + world, seed, step) from error

    def row_of(self, world: int) -> int:
        """Return the row of actors in which a world is."""
        return self._row + world

    def as_rows(self, rows: Rows) -> Rows:
        """Return rows of worlds as those of actors."""
        return Rows(rows.index + self._row, rows.seed, rows.step) if self._row else rows

    def begin_rows(self, actor: Actor | None, index: WorldIndex) -> None:
        """Let an actor begin the episodes of worlds."""
        if actor is not None:
            actor.begin(self.as_rows(self.playing.select(index)))

    def teach(self, rows: Rows) -> Any:
        """Return the teacher's actions in the present step; None without a teacher. Call it at every step."""
        if self.teacher is None:
            return None
        return self.teacher.act(self.worlds.teacher_sees(rows.index), self.as_rows(rows))[1]

    def begin(self, arrays: SharedArrays, index: WorldIndex, seeds: Sequence[int]) -> dict[str, Any]:
        """Begin episodes; return their first observations by key, with what only the critic sees."""
        self.times_s[index] = 0.0
        self.deepest[index] = np.nan
        envs = self.first + index
        arrays.call_seed[envs], arrays.call_step[envs] = seeds, 0
        self.playing.seeds[index] = seeds
        self.worlds.step_of[index] = 0
        self.worlds.shorten(index, arrays.limit[envs])
        try:
            return self.show(self.playing.begin(index, seeds, arrays.level[envs]), index)
        except BaseException as error:  # a plugin may raise anything, SystemExit too
            self._fail(error, int(index[0]))

    def show(self, observations: Any, index: WorldIndex) -> dict[str, Any]:
        """Return observations by key, with what only the critic sees."""
        parts: dict[str, Any] = split(observations)
        if self._has_critic:
            parts = {**parts, CRITIC: self.worlds.observe_privileged(index)}
        return parts

    def repeat(self, arrays: SharedArrays, asked: messages.BeginEpisodes) -> list[int]:
        """Begin episodes and repeat their actions; return the environments whose episode ended or failed."""
        left: list[int] = []
        episodes = {env: asked.episodes[env] for env in self.envs if env in asked.episodes}
        while episodes:
            try:
                return left + self._repeat(arrays, episodes)
            except FailedInEpisode as failure:
                if not asked.may_fail:
                    raise
                # It did not fail the first time, so its state differs now; the others begin again without it.
                del episodes[failure.where[0]]
                left.append(failure.where[0])
                print_line(f"{failure} when it was replayed")
        return left

    def _repeat(self, arrays: SharedArrays, episodes: Mapping[int, tuple[int, NDArray[Any]]]) -> list[int]:
        """Take the recorded actions in lockstep; return the environments whose episode ended."""
        index = np.array([*episodes], np.int64) - self.first
        shown = self.begin(arrays, index, [seed for seed, _ in episodes.values()])
        self.write_current(arrays, index, shown)
        actions = {env - self.first: taken for env, (_, taken) in episodes.items()}
        lengths = np.array([len(actions.get(world, ())) for world in range(self.worlds.count)])
        has_actions = lengths[index] > 0
        first = {key: part[has_actions] for key, part in shown.items() if key != CRITIC}
        repeater = _Repeater(RecordedActions(actions), self, arrays)
        self.begin_rows(self.teacher, index)
        left: list[int] = []
        try:
            for played in self.playing.play(repeater, index[has_actions], join(first)):
                index = played.index
                self.write_current(arrays, index, self.show(played.result.observation, index))
                left += (played.ended + self.first).tolist()
                self.playing.stop(index[self.worlds.step_of[index] >= lengths[index]])
        except BaseException as error:  # a plugin may raise anything, SystemExit too
            self._fail(error, int(index[0]))
        arrays.call_step[self.first : self.first + self.worlds.count] = -1
        return left

    def write_current(self, arrays: SharedArrays, index: WorldIndex, shown: Mapping[str, Any]) -> None:
        """Write the present observations of worlds, by key."""
        for key, part in shown.items():
            arrays.observation[key][self.first + index] = part

    def play(
        self, arrays: SharedArrays, asked: messages.Play, begin: Mapping[int, int], actor: Actor
    ) -> list[EpisodeResult]:
        """Play a segment in the environments of `begin`; return the episodes that ended, by environment and row."""
        index = np.array(sorted(begin), np.int64) - self.first
        segment = _Segment(self, arrays, asked, actor)
        try:
            return segment.write(index, np.array([begin[self.first + world] for world in index.tolist()], np.int64))
        except FailedInEpisode:
            raise
        except BaseException as error:  # a plugin may raise anything, SystemExit too
            self._fail(error, int(segment.index[0]))


class _Repeater(Actor):
    """An actor that acts as another, and lets the teacher see every step: it may have a recurrent state."""

    def __init__(self, actor: RecordedActions, episodes: Episodes, arrays: SharedArrays) -> None:
        self._actor, self._episodes, self._arrays = actor, episodes, arrays

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the actor's actions."""
        self._episodes.teach(rows)
        self._arrays.call_step[self._episodes.first + rows.index] = rows.step + 1
        return self._actor.act(observations, rows)


class _Segment(Actor):
    """Writes a segment: as an actor what was chosen, before the worlds step; in `write` what they returned."""

    def __init__(self, episodes: Episodes, arrays: SharedArrays, asked: messages.Play, actor: Actor) -> None:
        self._episodes, self._arrays, self._asked, self._actor = episodes, arrays, asked, actor
        self._worlds, self._first = episodes.worlds, episodes.first
        own = slice(self._first, self._first + self._worlds.count)
        self._segment = arrays.segment.by_step(own)  # arrays of shape (steps, worlds, ...)
        self._steps, self._rows = arrays.call_step[own], arrays.call_row[own]
        self._ones = np.ones(self._worlds.count, np.int64)
        self.index: WorldIndex = np.zeros(1, np.int64)  # the worlds that play, for errors
        self._row = 0
        self._acting_s = self._stepping_s = 0.0  # since the worlds that play changed last
        self._acted_s = 0.0  # when the last action was chosen
        self._ended: list[EpisodeResult] = []
        following = asked.next_episodes.items()
        self._seeds = {
            env: list_training_seeds(asked.run_seed, env, number) for env, number in following if env in episodes.envs
        }
        contacts = [env - self._first for env in asked.contacts if env in episodes.envs]
        self._contacts = np.array(contacts, np.int64)

    def _at(self, row: int, index: WorldIndex) -> Any:
        """Return the place of some worlds in a row of arrays; NumPy is fastest where the whole row is meant."""
        if len(index) == self._worlds.count:
            return row
        return row, index

    def write(self, index: WorldIndex, seeds: NDArray[np.int64]) -> list[EpisodeResult]:
        """Begin the episodes whose seeds are not negative, play, and write what the worlds return."""
        arrays, asked, segment = self._arrays, self._asked, self._segment
        episodes, playing = self._episodes, self._episodes.playing
        self.index = index
        new = index[seeds >= 0]
        if len(new):
            shown = episodes.begin(arrays, new, seeds[seeds >= 0].tolist())
            episodes.write_current(arrays, new, shown)
            episodes.begin_rows(self._actor, new)
            episodes.begin_rows(episodes.teacher, new)
        envs = self._first + index
        for key, part in segment.observation.items():
            part[0, index] = arrays.observation[key][envs]
        first = {key: part[envs] for key, part in arrays.observation.items() if key != CRITIC}
        arrays.call_seed[envs] = playing.seeds[index]
        observations = segment.observation.items()
        only = segment.observation[SINGLE] if list(segment.observation) == [SINGLE] else None
        segment.terminated[:, index], segment.truncated[:, index] = False, False
        began = perf_counter()
        for played in playing.play(self, index, join(first)):
            result, row = played.result, self._row
            self._stepping_s += perf_counter() - self._acted_s
            self._acting_s += self._acted_s - began
            self.index = played.index
            at = self._at(row, played.index)
            after = row + 1 if at is row else (row + 1, played.index)
            segment.reward[at] = result.reward
            if len(played.ended):
                segment.terminated[at], segment.truncated[at] = result.terminated, result.truncated
            if asked.record:
                segment.terms[at] = result.terms
            if only is not None:
                only[after] = result.observation
            else:
                shown = episodes.show(result.observation, played.index)
                for key, part in observations:
                    part[after] = shown[key]
            if len(self._contacts):
                self._measure_contacts()
            if len(played.ended):
                self._finish(played.ended)
            self._row = row + 1
            if self._row == asked.steps:
                running = self.index if self._seeds else np.setdiff1d(self.index, played.ended)
                self._keep_last(running)
                break
            began = perf_counter()
        self._note_times()
        self._steps[:] = -1
        # In the order of environments that play one after the other.
        return sorted(self._ended, key=lambda ended: ended.env)

    def _keep_last(self, index: WorldIndex) -> None:
        for key, part in self._segment.observation.items():
            self._arrays.observation[key][self._first + index] = part[self._row, index]

    def _note_times(self) -> None:
        """Add the times since the last call to those of the episodes that play, each its share."""
        if len(self.index):
            share = 1.0 / len(self.index)
            self._episodes.times_s[self.index] += self._acting_s * share, self._stepping_s * share
        self._acting_s = self._stepping_s = 0.0

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the actor's actions, or those of the teacher where it acts, as they are written."""
        segment, row = self._segment, self._row
        at = self._at(row, rows.index)
        stored, action = self._actor.act(observations, self._episodes.as_rows(rows))
        if self._episodes.teacher is not None:
            label = self._episodes.teach(rows)
            segment.label[at] = label
            taught = np.isin(self._first + rows.index, self._asked.taught)
            stored[taught], action[taught] = label.reshape(stored.shape)[taught], label[taught]
        segment.stored[at], segment.action[at] = stored, action
        if at is row:
            np.add(rows.step, self._ones, out=self._steps)
            self._rows.fill(row)
        else:
            self._steps[rows.index], self._rows[rows.index] = rows.step + 1, row
        self._acted_s = perf_counter()
        return stored, action

    def _measure_contacts(self) -> None:
        deepest = self._episodes.deepest
        for world in np.intersect1d(self.index, self._contacts).tolist():
            deepest[world] = np.fmax(deepest[world], self._worlds.deepest_contact(world))

    def _finish(self, ended: WorldIndex) -> None:
        """Note the episodes that ended in some worlds, and begin those that follow them."""
        arrays, asked, segment, row = self._arrays, self._asked, self._segment, self._row
        self._note_times()
        results = [self._summarize(world) for world in ended.tolist()]
        self._ended += results
        envs = self._first + ended
        if not self._seeds:
            for key, part in segment.observation.items():
                arrays.observation[key][envs] = part[row + 1, ended]
            return
        for key, part in segment.final.items():
            part[row, ended] = segment.observation[key][row + 1, ended]
        if asked.levels is not None:
            for result in results:
                if not arrays.limit[result.env]:
                    arrays.level[result.env] = self._find_next_level(asked.levels, result)
        arrays.limit[envs] = 0  # only the first episodes are short
        self._rows[ended] = row + 1
        shown = self._episodes.begin(arrays, ended, [next(self._seeds[env]) for env in envs.tolist()])
        for key, part in shown.items():
            segment.observation[key][row + 1, ended] = part
        self._episodes.begin_rows(self._actor, ended)
        self._episodes.begin_rows(self._episodes.teacher, ended)

    def _find_next_level(self, rule: messages.LevelRule, result: EpisodeResult) -> float:
        own = self._worlds.next_level(result.env - self._first)
        if own is not None:
            return float(own)
        return rule.follow(float(self._arrays.level[result.env]), result.success)

    def _summarize(self, world: int) -> EpisodeResult:
        totals = self._worlds.totals(world)
        acting, stepping = self._episodes.times_s[world].tolist()
        deepest = float(self._episodes.deepest[world])
        return EpisodeResult(
            env=self._first + world,
            seed=int(self._episodes.playing.seeds[world]),
            total_reward=totals.reward,
            length=int(self._worlds.step_of[world]),
            success=totals.success,
            terms=totals.terms,
            final_distance=totals.distance,
            row=self._row,
            report=self._actor.report(self._episodes.row_of(world)),
            deepest_contact=None if np.isnan(deepest) else deepest,
            acting=acting / max(acting + stepping, 1e-9),
            metrics=totals.metrics,
            drawn=totals.drawn,
        )


def compute_rewards(worlds: Any, achieved: NDArray[Any], desired: NDArray[Any]) -> NDArray[np.float64]:
    """Return the rewards, shape (n,), that worlds compute for goals of shape (n, *goal); else `TaskError`."""
    count = len(achieved)
    infos: list[dict[str, Any]] = [{} for _ in range(count)]
    try:
        rewards = np.asarray(worlds.compute_reward(achieved, desired, infos))
    except BaseException as error:  # a plugin may raise anything, SystemExit too
        raise TaskError(
            f"compute_reward raised {describe_exception(error)}", details=format_plugin_traceback(error)
        ) from error
    if rewards.dtype.kind not in "fiub":
        raise TaskError(f"compute_reward returned an array of {rewards.dtype}, not of numbers")
    if rewards.shape != (count,):
        raise TaskError(f"compute_reward returned shape {rewards.shape} for {count} goals at once, not ({count},)")
    if not np.isfinite(rewards).all():
        bad = int(np.flatnonzero(~np.isfinite(rewards))[0])
        raise TaskError(f"compute_reward is {rewards[bad]} for achieved {achieved[bad]}, desired {desired[bad]}")
    return rewards.astype(np.float64)
