"""Episodes with goals that the check moves, and where a goal is a success."""

import dataclasses
import functools
from collections.abc import Iterable, Iterator

import numpy as np

from rlctl.checking.drawn_goals import TURNED, DrawnGoal, Numbers, Source, find_sources, read_part, read_place
from rlctl.checking.episode import EpisodePlayer, Moment
from rlctl.checking.instance import Instance
from rlctl.checking.records import FIRST_SEED, SECOND_SEED
from rlctl.checking.snapshots import Beginnings
from rlctl.checking.transitions import flatten_floats, list_float_parts
from rlctl.checking.values import name_numbers, read_flag
from rlctl.checking.workspaces import find_chains
from rlctl.environments.success import SUCCESS

ROUNDING = 1e-5  # of observations to float32
PLACED_EPISODES, MOST_PLACED_EPISODES = 3, 8  # that are needed, and that are tried
PLACED_STEPS = 3  # after which a goal is put at the place of the robot
HELD_STEPS = 25  # after the first one, for which a goal may have to be held
MOST_ARRIVALS = 3  # that a success may need, each at another goal
STARTS_COMPARED = 9
MOST_SOURCES = 24  # places in the observation at which it is put
MOST_OTHERS = 40  # places of other things
TURN_SHIFT = 0.1  # of a goal along each axis, to see how the observation turns it
TURNS = (2 * np.pi, 360.0)  # one turn [rad, deg]
TURNED_STEPS = 2  # with the goal a turn further: of the first, progress is the way of the goal too
SAME_REWARD = 1e-5  # of the rewards, or of 1: what float32 makes of an angle and of another a turn further


@dataclasses.dataclass(frozen=True)
class GoalStep:
    """What a step returned."""

    reward: float  # NaN where it is no number
    succeeds: bool | None  # None where no success is reported


@dataclasses.dataclass(frozen=True)
class GoalTrials:
    """An instance whose goal can be moved: the parts play short episodes with it, and leave it as they like."""

    instance: Instance
    drawn: DrawnGoal
    turned_places: dict[tuple[Source, int, str, int], Numbers] = dataclasses.field(default_factory=dict)
    """Where the robot is by a turned source, its seed, kind of actions and steps: goals move no robot."""
    turnings: dict[tuple[int, int, str, int], Numbers] = dataclasses.field(default_factory=dict)
    """How the observation turns the way to the goal, by its element and the same."""
    begun: Beginnings = dataclasses.field(default_factory=Beginnings)

    @functools.cached_property
    def goals(self) -> Numbers:
        """The drawn goals. Shape (n, size)."""
        return np.array(list(self.drawn.goals.values()))

    def name_elements(self, first: int, count: int = 1) -> str:
        """Return how to write elements of the observation that follow each other."""
        return name_numbers(list_float_parts(self.instance.leaves), first, count)

    @property
    def range(self) -> Numbers:
        """How far the goals lie apart. Shape (size,)."""
        return np.asarray(np.ptp(self.goals, axis=0))

    @functools.cached_property
    def turns(self) -> Numbers:
        """How long a turn is along each axis that is an angle, after which the same is paid again; infinite along the
        others. Only axes are tried of which the goals cover more than half a turn. Shape (size,)."""
        turns = np.full(self.range.shape, np.inf)
        for axis, covered in enumerate(self.range):
            for turn in TURNS:
                if covered > turn / 2 and self._repeats(axis, turn):
                    turns[axis] = turn
                    break
        return turns

    def _repeats(self, axis: int, turn: float) -> bool:
        """Say whether goals pay the same that are a turn apart, and others do not."""
        for seed in (FIRST_SEED, SECOND_SEED):
            goal = GoalEpisode(self, seed).goal
            # To the other side of zero: some rewards add or subtract one turn only.
            way = -np.copysign(turn, goal[axis]) * np.eye(goal.size)[axis]
            here, quarter, whole = (self._pay(seed, goal + part * way) for part in (0.0, 0.25, 1.0))
            if not _is_same(here, whole) or _is_same(here, quarter):
                return False
        return True

    def _pay(self, seed: int, goal: Numbers) -> Numbers:
        """Return what some later steps pay with a goal; fewer where the episode ends. Shape (steps,)."""
        episode = GoalEpisode(self, seed, "repeated", PLACED_STEPS)
        return np.array([step.reward for step in episode.play([goal] * TURNED_STEPS)])

    @functools.cached_property
    def at_goal(self) -> "AtGoal":
        """Where the observation has the place at which a goal is a success."""
        episode = GoalEpisode(self, FIRST_SEED, "repeated", PLACED_STEPS)
        reports_success = not episode.has_ended and episode.step().succeeds is not None
        sources = self.list_sources(episode) if reports_success else []
        # What rolls or falls may have to rest where it is held: the zero action.
        tries = [(source, "repeated") for source in sources] + [(one, "zero") for one in sources if one[1]]
        for source, actions in tries:
            if self.is_success_at(source, actions):
                return AtGoal(source, reports_success)
        return AtGoal(None, reports_success)

    def list_sources(self, episode: "GoalEpisode") -> list[Source]:
        """Return where the observation may have the place of the robot: relative to the goal, and then by itself."""
        plain = find_sources(self.drawn.copies, episode.observed[None], episode.goal[None])
        return [*self.drawn.turned, *plain][:MOST_SOURCES] + self._list_others(episode)

    def _list_others(self, episode: "GoalEpisode") -> list[Source]:
        """Return where it may have the place of something else, in a frame in which it has the goal."""
        size, observed = episode.goal.size, episode.observed
        found: list[Source] = []
        # Next to a pose the observation has no other one in the same three numbers.
        known = [] if self.drawn.place.is_pose else [*self.drawn.turned, *self.drawn.copies]
        for element, sign in known:
            is_world = np.allclose(observed[element : element + size], sign * episode.goal, atol=ROUNDING)
            for other in range(0 if is_world else observed.size - size + 1):
                if abs(other - element) >= size:
                    found.append((element, sign, other))
        return found[:MOST_OTHERS]

    def is_success_at(self, source: Source, actions: str = "repeated") -> bool:
        """Say whether a goal at a place of the observation is a success, in several episodes."""
        tried = 0
        for seed in range(FIRST_SEED, FIRST_SEED + MOST_PLACED_EPISODES):
            place = self.find_place(source, seed, actions)
            if place is None:  # it ends, or succeeds, too early
                continue
            # A place by itself may be anything: to hold the goal at each takes long.
            if not self.succeeds(seed, place, source if source[1] else None, actions):
                return False
            tried += 1
            if tried == PLACED_EPISODES:
                return True
        return False

    def is_success_after(self, seed: int, source: Source, steps: int) -> bool:
        """Say whether the step after so many is a success with the goal at a place of the observation."""
        episode = GoalEpisode(self, seed, "repeated", steps)
        return not episode.has_ended and bool(episode.step(episode.read(source)).succeeds)

    def find_place(self, source: Source, seed: int, actions: str = "repeated") -> Numbers | None:
        """Return what is a place by a source, after a few steps, by default with the action that the seed draws; None
        if the episode ends or succeeds before."""
        episode = GoalEpisode(self, seed, actions, PLACED_STEPS)
        if episode.has_ended or episode.has_succeeded or episode.step(episode.goal).succeeds:
            return None
        return episode.read(source)

    def find_links(self, seed: int) -> dict[str, Numbers]:
        """Return where the links of fixed robots are after the same steps, by name; none if the episode ends before."""
        episode = GoalEpisode(self, seed, "repeated", PLACED_STEPS)
        if episode.has_ended or episode.has_succeeded or episode.step(episode.goal).succeeds:
            return {}
        places: dict[str, Numbers] = {}
        for chain in find_chains(self.instance.env, self.instance.find_clients()):
            places |= dict(zip(chain.names, chain.read()[:, self.drawn.place.axes], strict=True))
        return places

    def succeeds(
        self, seed: int, goal: Numbers, source: Source | None = None, actions: str = "repeated"
    ) -> bool | None:
        """Say whether the last of these steps is a success with the goal at a place, or one of some later steps in
        which it stays as far from the place of the robot by a source; None if it is not played."""
        episode = GoalEpisode(self, seed, actions, PLACED_STEPS)
        if episode.has_ended:
            return None
        return episode.hold(goal, source).succeeds


@dataclasses.dataclass(frozen=True)
class AtGoal:
    """What has to be at the goal."""

    source: Source | None  # None if no goal at any place of the observation was a success
    reports_success: bool


class GoalEpisode:
    """An episode whose goal is set before each of its later steps."""

    def __init__(
        self, trials: GoalTrials, seed: int, actions: str = "zero", first: int = 0, *, together: bool = True
    ) -> None:
        """Reset, and play the first steps with the goal that was drawn; `actions` is a kind of `draw_actions`. Where
        there are several goals, all are moved `together`, or the first one alone."""
        self._trials, self._seed, self._actions, self._first, self._together = trials, seed, actions, first, together
        self._goals: list[Numbers | None] = []  # by step
        self._instance = trials.instance
        self._player = EpisodePlayer(self._instance, seed, actions)
        self._place = trials.drawn.place
        self.has_succeeded = False  # whether any of its steps was a success
        if self._resume(first):
            return
        moment = self._player.reset()
        self._attribute = self._place.find(self._instance.env)
        self.goal = self._place.pick(self._attribute)
        self.observed = self._flatten(moment)  # Shape (elements,)
        self.play([None] * first)
        if not self.has_ended:
            trials.begun.keep(self._player, (seed, actions, first), vars(self))

    def _resume(self, first: int) -> bool:
        """Go on from the last episode's beginning, if it was the same; say whether it was."""
        kept = self._trials.begun.restore((self._seed, self._actions, first))
        if kept is None:
            return False
        together = self._together
        vars(self).update(kept)
        self._together = together
        self._goals = [None] * first
        self._player = EpisodePlayer(self._instance, self._seed, self._actions)
        self._player.resume(first)
        return True

    def _flatten(self, moment: Moment) -> Numbers:
        return self._trials.drawn.extend(flatten_floats(self._instance.leaves, moment.observation))

    @property
    def has_ended(self) -> bool:
        """Whether there is no other step."""
        return bool(self._player.ended)

    def step(self, goal: Numbers | None = None) -> GoalStep:
        """Set the goal, if one is given, and take a step."""
        if goal is not None:
            self._attribute = self._place.find_again(self._attribute, self._instance.env)
            self.goal = self._place.assign(self._attribute, goal, self._together)
        self._goals.append(goal)
        moment = self._player.step()
        self.observed = self._flatten(moment)
        succeeds = _read_success(moment)
        self.has_succeeded |= bool(succeeds)
        return GoalStep(moment.reward_number, succeeds)

    def hold(self, goal: Numbers, source: Source | None = None) -> GoalStep:
        """Step until a success, as some tasks want a goal to be held for a while, or several of them: once, or, with a
        source, with the goal as far from the robot as now."""
        away = goal - self.read(source) if source is not None else np.zeros(goal.size)
        step = self.step(goal)
        left, arrivals = HELD_STEPS if source is not None else 0, 0
        while left and step.succeeds is False and not self.has_ended:
            assert source is not None
            if self.has_moved_on and arrivals < MOST_ARRIVALS:
                left, arrivals = HELD_STEPS, arrivals + 1
                self.goal = self._place.read(self._instance.env)
                step = self.step()
            else:
                step = self.step(self.read(source) + away)
            left -= 1
        return step

    def lead(self, source: Source, before: Numbers, offsets: Iterable[Numbers]) -> Iterator[tuple[GoalStep, Numbers]]:
        """Take a step for each offset, with the goal so far from where the robot gets if it moves as in the step
        before; `before` is where it was then. Yield the steps, and where the robot was before each; less if the
        episode ends."""
        for offset in offsets:
            if self.has_ended:
                return
            place = self.read(source)
            yield self.step(2 * place - before + offset), place
            before = place

    @property
    def has_moved_on(self) -> bool:
        """Whether the environment has replaced the goal that the last step was given."""
        return not np.array_equal(self._place.read(self._instance.env), self.goal)

    def read(self, source: Source) -> Numbers:
        """Return the place of the robot by a source, after a step. Shape (size,)."""
        if source[1] == TURNED:
            return self._read_turned(source)
        return read_place(source, self.observed[None], self.goal[None])[0]

    def _read_turned(self, source: Source) -> Numbers:
        key = source, self._seed, self._actions, len(self._goals)
        if key not in self._trials.turned_places and self.has_moved_on:
            self._read_beside(source)  # this observation has the way to another goal already
        if key not in self._trials.turned_places:
            part = read_part(source, self.observed[None], self.goal.size)[0]
            way, *_ = np.linalg.lstsq(self.read_turn(source[0]), part, rcond=None)
            self._trials.turned_places[key] = self.goal - way
        return self._trials.turned_places[key]

    def _read_beside(self, source: Source) -> None:
        """Read a place in the same steps with the goal that was drawn; leave the environment as this episode did."""
        first = min(self._first, len(self._goals))
        other = GoalEpisode(self._trials, self._seed, self._actions, first, together=self._together)
        other.play([None] * (len(self._goals) - first))
        if not other.has_moved_on:
            other.read(source)
        again = GoalEpisode(self._trials, self._seed, self._actions, first, together=self._together)
        again.play(self._goals[first:])

    def read_turn(self, element: int) -> Numbers:
        """Return how the observation turns the way to the goal, after a step. Shape (size, size). The same steps are
        played again with the goal of the last one shifted."""
        key = element, self._seed, self._actions, len(self._goals)
        if key not in self._trials.turnings:
            parts = []
            # The last one leaves the environment as this episode did.
            for shift in [*TURN_SHIFT * np.eye(self.goal.size), np.zeros(self.goal.size)]:
                # With the same first steps, so that they need not be played again.
                first = min(self._first, len(self._goals) - 1)
                again = GoalEpisode(self._trials, self._seed, self._actions, first, together=self._together)
                again.play([*self._goals[first:-1], self.goal + shift])
                parts.append(again.observed[element : element + self.goal.size])
            *shifted, plain = parts
            self._trials.turnings[key] = (np.stack(shifted, axis=1) - plain[:, None]) / TURN_SHIFT
        return self._trials.turnings[key]

    def measure_distance(self, source: Source) -> float:
        """Return how far the goal is from the robot by a source."""
        if source[1]:
            part = read_part(source, self.observed[None], self.goal.size)
            return float(np.linalg.norm(part)) / self._trials.drawn.read_scale(source[0])
        return float(np.linalg.norm(self.read(source) - self.goal))

    def play(self, goals: Iterable[Numbers | None]) -> list[GoalStep]:
        """Take a step for each goal; less if the episode ends."""
        return list(self.follow(goals))

    def follow(self, goals: Iterable[Numbers | None]) -> Iterator[GoalStep]:
        """Take these steps one by one, for who looks at the episode after each."""
        for goal in goals:
            if self.has_ended:
                break
            yield self.step(goal)


def _is_same(one: Numbers, two: Numbers) -> bool:
    return one.shape == two.shape and np.allclose(one, two, rtol=SAME_REWARD, atol=SAME_REWARD)


def _read_success(moment: Moment) -> bool | None:
    if not isinstance(moment.info, dict) or SUCCESS not in moment.info:
        return None
    return read_flag(moment.info[SUCCESS])


def measure_distances(trials: GoalTrials, source: Source) -> Numbers:
    """Return how far the goal is from the robot at the start of some episodes. Shape (STARTS_COMPARED,)."""
    episodes = [GoalEpisode(trials, FIRST_SEED + number) for number in range(STARTS_COMPARED)]
    return np.array([episode.measure_distance(source) for episode in episodes])
