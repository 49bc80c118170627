"""The experiment `goals`: finds a goal that reset draws and the observation shows, for rules about rewards."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer, Moment
from rlctl.checking.experiment import PROBE, JudgeHook, experiment
from rlctl.checking.experiments.episodes import EPISODES
from rlctl.checking.experiments.starts import FIRST, STARTS
from rlctl.checking.instance import Context, Instance
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage, Fact
from rlctl.checking.rule import NotApplicable, NotJudged
from rlctl.checking.snapshots import Beginnings
from rlctl.checking.term_names import is_about_goals
from rlctl.checking.transitions import flatten_floats
from rlctl.checking.values import Attribute, read_attributes, read_flag, shape_like
from rlctl.checking.workspaces import Reach, find_chains, measure_reach
from rlctl.environments.success import SUCCESS

SIZES = (1, 2, 3)  # of a place [numbers]
SPACE = 3  # axes of the world
MOST_CANDIDATES = 6
STEPS = 3  # in which a goal does not change
SHIFT = np.array([0.013, -0.021, 0.034])  # of a goal, to see what of the observation follows it
ROUNDING, PART = 1e-5, 5e-7  # of observations to float32, and of large ones
MOST_NOISE = 2e-4  # of elements, from an episode to the same one again
COMPARED = 4  # resets after which the places of links are compared with the observation
SMALLER_UNITS = (100.0, 1000.0)  # times as many of them [cm, mm]
SCALED_GOAL = "goal in a smaller unit"
NEAR = 2e-3  # how near they are [m]
PLACED_EPISODES, MOST_PLACED_EPISODES = 3, 8  # that are needed, and that are tried
PLACED_STEPS = 3  # after which a goal is put at the place of the robot
HELD_STEPS = 25  # after the first one, for which a goal may have to be held
MOST_ARRIVALS = 3  # that a success may need, each at another goal
STARTS_COMPARED = 9
MOST_SOURCES = 24  # places in the observation at which it is put
MOST_OTHERS = 40  # places of other things
Numbers = NDArray[np.float64]
Source = tuple[int, ...]
"""The element of an observation from which on it has a place, and the sign with which the goal is in it; 0 for a place
by itself, and `TURNED` for the way to the goal in the frame of a robot that turns. A third number is the element from
which on the observation has another place in the same frame, such as that of an object: that is then the place."""
TURNED = 2
TURN_SHIFT, TURN_ERROR = 0.1, 1e-3  # of a goal along each axis, to see how the observation turns it
LEAST_SCALE, SCALED_ROUNDING = 1e-3, 2e-7  # of a way in the observation, and what float32 makes of it
TURNS = (2 * np.pi, 360.0)  # one turn [rad, deg]
TURNED_STEPS = 2  # with the goal a turn further: of the first, progress is the way of the goal too
SAME_REWARD = 1e-5  # of the rewards, or of 1: what float32 makes of an angle and of another a turn further


@dataclasses.dataclass(frozen=True)
class DrawnPlace:
    """Elements of an attribute: a whole place, or what a reset draws of it where the rest is constant."""

    name: str  # of the attribute
    elements: tuple[int, ...]
    later: tuple[tuple[int, ...], ...] = ()  # The elements of the goals after it, where there are several

    @property
    def size(self) -> int:
        """How many numbers the place has."""
        return len(self.elements)

    @property
    def axes(self) -> list[int]:
        """The axes of the world that the elements are, where places of links are compared with them."""
        return list(self.elements if max(self.elements) < SPACE else range(self.size))

    def find(self, env: Any) -> Attribute:
        """Return the attribute, with a copy of its present value."""
        return read_attributes(env)[self.name]

    def read(self, env: Any) -> Numbers:
        """Return the place. Shape (size,)."""
        return self.pick(self.find(env))

    def pick(self, attribute: Attribute) -> Numbers:
        """Return the place that an attribute has. Shape (size,)."""
        return attribute.numbers[list(self.elements)]

    def assign(self, attribute: Attribute, place: Numbers, together: bool = False) -> None:
        """Replace the place in the environment, and `together` all later goals; the other elements become those of the
        copy."""
        numbers = attribute.numbers.copy()
        for elements in [self.elements, *(self.later if together else ())]:
            numbers[list(elements)] = place
        attribute.assign(shape_like(attribute.value, numbers))


@dataclasses.dataclass(frozen=True)
class DrawnGoal:
    """A place that each reset draws."""

    place: DrawnPlace
    copies: Sequence[Source]  # Where the observation has it, or its difference to something
    turned: Sequence[Source]  # Where the observation has its difference to something, turned
    goals: Mapping[int, Sequence[float]]  # by seed
    reaches: Mapping[Source, Reach]  # of links of a fixed robot, by where the observation has their places
    scales: Mapping[int, float] = dataclasses.field(default_factory=dict)
    """How many units of the observation a unit of the place is, by the elements of `turned`."""

    def read_scale(self, element: int) -> float:
        """Return how many units of the observation a unit of the place is, where it has the way to it."""
        return self.scales.get(element, 1.0)

    @property
    def name(self) -> str:
        """The name of the attribute."""
        return self.place.name

    def name_axis(self, axis: int) -> str:
        """Name an element of the place: `self.goal[1]`."""
        is_number = self.place.elements == (0,)
        return self.name if is_number else f"{self.name}[{self.place.elements[axis]}]"


@dataclasses.dataclass(frozen=True)
class ScaledGoal:
    """A place that each reset draws, and that the observation has in a smaller unit: the fact `SCALED_GOAL`."""

    name: str  # of the attribute
    element: int  # of the observation, from which on it has the place
    factor: float
    size: float  # of what is observed there


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
        for element, sign in [*self.drawn.turned, *self.drawn.copies]:
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
        self._trials, self._seed, self._actions, self._together = trials, seed, actions, together
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
        self.observed = flatten_floats(self._instance.leaves, moment.observation)  # Shape (elements,)
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

    @property
    def has_ended(self) -> bool:
        """Whether there is no other step."""
        return bool(self._player.ended)

    def step(self, goal: Numbers | None = None) -> GoalStep:
        """Set the goal, if one is given, and take a step."""
        if goal is not None:
            self._place.assign(self._attribute, goal, self._together)
            self.goal = goal
        self._goals.append(goal)
        moment = self._player.step()
        self.observed = flatten_floats(self._instance.leaves, moment.observation)
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
        if key not in self._trials.turned_places:
            part = read_part(source, self.observed[None], self.goal.size)[0]
            way, *_ = np.linalg.lstsq(self.read_turn(source[0]), part, rcond=None)
            self._trials.turned_places[key] = self.goal - way
        return self._trials.turned_places[key]

    def read_turn(self, element: int) -> Numbers:
        """Return how the observation turns the way to the goal, after a step. Shape (size, size). The same steps are
        played again with the goal of the last one shifted."""
        key = element, self._seed, self._actions, len(self._goals)
        if key not in self._trials.turnings:
            parts = []
            # The last one leaves the environment as this episode did.
            for shift in [*TURN_SHIFT * np.eye(self.goal.size), np.zeros(self.goal.size)]:
                again = GoalEpisode(self._trials, self._seed, self._actions, together=self._together)
                again.play([*self._goals[:-1], self.goal + shift])
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


judges_goals = JudgeHook[GoalTrials]()
"""Shows an instance with a goal that can be moved."""


@experiment("goals", PROBE, 110, share=0.5, hooks=(judges_goals,))
def find_goals(context: Context) -> Iterator[ChildMessage]:
    """Find an attribute that is drawn at reset and stays, and the parts of the observation that follow it."""
    instance = context.instance
    if not instance.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    places, by_chance = _find_drawn(instance)
    for place in places:
        copies, scales = find_copies(instance, place), _find_turned(instance, place)
        turned = [(element, TURNED) for element in scales]
        if copies or turned:
            goals: dict[int, list[float]] = {}
            for seed in [*range(FIRST_SEED, FIRST_SEED + len(EPISODES)), *range(FIRST, FIRST + STARTS)]:
                if context.budget.why_spent():
                    break
                instance.reset(seed)
                goals[seed] = place.read(instance.env).tolist()
            drawn = DrawnGoal(place, copies, turned, goals, _find_reaches(instance, place, copies), scales)
            yield Fact("goals", drawn)
            yield from judges_goals.judge(GoalTrials(instance, drawn))
            return
    yield from _find_scaled(instance, places)
    if by_chance:
        raise NotJudged("the seed does not determine what reset draws (RL301)")
    raise NotApplicable("the observation follows no attribute that reset draws")


def _find_scaled(instance: Instance, places: Sequence[DrawnPlace]) -> Iterator[Fact]:
    """Yield the first attribute that the observation shows in a smaller unit."""
    for place in places:
        for factor in SMALLER_UNITS:
            if copies := find_copies(instance, place, factor):
                seen = _observe(instance, place, 0.0)[copies[0][0] :][: place.size]
                yield Fact(SCALED_GOAL, ScaledGoal(place.name, copies[0][0], factor, float(np.linalg.norm(seen))))
                return


def _find_drawn(instance: Instance) -> tuple[list[DrawnPlace], list[str]]:
    """Return the places in attributes that a reset draws by its seed and no step changes, and the names of the others
    that it draws."""
    found = find_drawn(instance, _list_places)
    candidates = sorted(
        found.stays, key=lambda name: (not is_about_goals(name), found.sizes[name] not in SIZES, name)
    )[:MOST_CANDIDATES]
    return [place for name in candidates for place in found.stays[name]], found.by_chance


@dataclasses.dataclass(frozen=True)
class DrawnPlaces:
    """What resets draw, by the names of attributes."""

    stays: Mapping[str, Sequence[DrawnPlace]]  # by its seed, and no step changes it
    by_chance: list[str]  # what else they draw
    sizes: Mapping[str, int]  # of the attributes that stay


def find_drawn(instance: Instance, list_places: Callable[[Attribute, Attribute], list[DrawnPlace]]) -> DrawnPlaces:
    """Return what resets draw; `list_places` returns the places in an attribute that two resets drew differently."""
    again, *drawn = (_read_after_reset(instance, seed) for seed in (FIRST_SEED, FIRST_SEED, SECOND_SEED))
    places = {name: list_places(drawn[0][name], drawn[1][name]) for name in drawn[0].keys() & drawn[1].keys()}
    names = [name for name, found in places.items() if found]
    seeded = [name for name in names if name in again and np.array_equal(again[name].numbers, drawn[0][name].numbers)]
    by_chance = sorted({*names} - {*seeded})
    if not seeded:
        return DrawnPlaces({}, by_chance, {})
    for _ in EpisodePlayer(instance, SECOND_SEED, max_steps=STEPS):
        pass
    after = read_attributes(instance.env)
    stays = [name for name in seeded if name in after and np.array_equal(after[name].numbers, drawn[1][name].numbers)]
    sizes = {name: drawn[0][name].numbers.size for name in stays}
    return DrawnPlaces({name: places[name] for name in stays}, by_chance, sizes)


def _read_after_reset(instance: Instance, seed: int) -> dict[str, Attribute]:
    EpisodePlayer(instance, seed, max_steps=0).reset()
    return read_attributes(instance.env)


def _list_places(one: Attribute, two: Attribute) -> list[DrawnPlace]:
    """Return the whole of an attribute if it may be a place, and then what two resets drew of it."""
    if np.asarray(one.value).dtype.kind != "f":
        return []  # whole numbers are states and cells: an environment looks them up in tables
    size = one.numbers.size
    if size != two.numbers.size:
        return []
    drawn = tuple(np.flatnonzero(one.numbers != two.numbers).tolist())
    rows = np.shape(one.value)
    if len(rows) == 2 and rows[0] > 1 and rows[1] in SIZES[1:] and drawn:  # the first of several goals
        columns = sorted({element % rows[1] for element in drawn})
        if len(drawn) == rows[0] * len(columns) and len(columns) > 1:  # the same axes of each
            of_rows = [tuple(row * rows[1] + column for column in columns) for row in range(rows[0])]
            return [DrawnPlace(one.name, of_rows[0], tuple(of_rows[1:]))]
        return []
    if len(drawn) not in SIZES or len(drawn) < min(2, size):
        return []
    found = [DrawnPlace(one.name, tuple(range(size)))] if size in SIZES else []
    if len(drawn) < size:
        found.append(DrawnPlace(one.name, drawn))
    return found


def find_copies(instance: Instance, place: DrawnPlace, factor: float = 1.0) -> list[tuple[int, int]]:
    """Return where the observation has the place, or its difference to something, times a factor; and the sign."""
    before, plain, shifted = (_observe(instance, place, shift) for shift in (0.0, 0.0, 1.0))
    if before.shape != plain.shape or plain.shape != shifted.shape:
        return []
    noise = np.minimum(np.abs(plain - before), MOST_NOISE)  # an engine may keep contacts of the episode before
    change, shift = shifted - plain, factor * SHIFT[: place.size]
    parts = [change[element : element + len(shift)] for element in range(len(change) - len(shift) + 1)]
    allowed = ROUNDING + PART * np.abs(plain) + 2 * noise
    most = [allowed[i : i + len(shift)].max() for i in range(len(parts))]
    return [
        (i, sign) for i, part in enumerate(parts) for sign in (1, -1) if np.abs(part - sign * shift).max() < most[i]
    ]


def _find_turned(instance: Instance, place: DrawnPlace) -> dict[int, float]:
    """Return where the observation has the way to the place in a frame that is turned against the world's, or in
    another unit; and how many of its units a unit of the place is."""
    size = place.size
    plain = _observe(instance, place, 0.0)
    shifted = [_observe(instance, place, 1.0, TURN_SHIFT * axis) for axis in np.eye(size)]
    if size < 2 or any(row.shape != plain.shape for row in shifted):
        return {}
    turns = np.stack([row - plain for row in shifted]) / TURN_SHIFT  # shape (size, elements)
    found: dict[int, float] = {}
    for element in range(plain.size - size + 1):
        turn = turns[:, element : element + size]
        scale = float(np.sqrt(np.square(turn).sum() / size))  # of a unit of the observation
        if scale < LEAST_SCALE:
            continue
        rounding = SCALED_ROUNDING * np.abs(plain).max() / (scale * TURN_SHIFT)
        error, turn = TURN_ERROR + rounding, turn / scale
        is_rotation = np.abs(turn @ turn.T - np.eye(size)).max() < error
        is_plain = np.abs(np.abs(turn) - np.eye(size)).max() < error and abs(scale - 1.0) < error
        if is_rotation and not is_plain:
            found[element] = scale if abs(scale - 1.0) > error else 1.0
    return found


def _observe(instance: Instance, place: DrawnPlace, shift: float, along: Numbers = SHIFT) -> Numbers:
    """Return the observation of the first step if the place is shifted before it. Shape (elements,)."""
    episode = EpisodePlayer(instance, FIRST_SEED, "zero", max_steps=1)
    episode.reset()
    attribute = place.find(instance.env)
    place.assign(attribute, place.pick(attribute) + shift * along[: place.size])
    return flatten_floats(instance.leaves, episode.step().observation)


def _find_reaches(instance: Instance, place: DrawnPlace, copies: Sequence[Source]) -> dict[Source, Reach]:
    """Return how far the links of fixed robots get whose places are observed, by where they are observed."""
    rows, goals, links = [], [], []
    for seed in range(FIRST_SEED, FIRST_SEED + COMPARED):
        first = EpisodePlayer(instance, seed, max_steps=0).reset()
        rows.append(flatten_floats(instance.leaves, first.observation))
        goals.append(place.read(instance.env))
        chains = list(find_chains(instance.env, instance.find_clients()))
        if not chains:
            return {}
        links.append([chain.read() for chain in chains])
    observed, drawn = np.array(rows), np.array(goals)
    reaches: dict[Source, Reach] = {}
    for source in find_sources(copies, observed, drawn):
        places = read_place(source, observed, drawn)
        for number, chain in enumerate(chains):
            off = np.abs(np.array([one[number] for one in links])[:, :, place.axes] - places[:, None])
            link = int(off.max(axis=(0, 2)).argmin())
            if off[:, link].max() < NEAR and source not in reaches:
                reach = measure_reach(chain, link, place.axes)
                # A goal minus itself is the origin, where the base of many robots is.
                reaches |= {source: reach} if reach.distance > NEAR else {}
    return reaches


def measure_distances(trials: GoalTrials, source: Source) -> Numbers:
    """Return how far the goal is from the robot at the start of some episodes. Shape (STARTS_COMPARED,)."""
    episodes = [GoalEpisode(trials, FIRST_SEED + number) for number in range(STARTS_COMPARED)]
    return np.array([episode.measure_distance(source) for episode in episodes])


def find_sources(copies: Sequence[Source], rows: Numbers, goals: Numbers) -> list[Source]:
    """Return where an observation may have the place of the robot: relative to the goal, and then by itself."""
    size = goals.shape[1]
    return [*copies, *((element, 0) for element in range(rows.shape[1] - size + 1))]


def read_place(source: Source, rows: Numbers, goals: Numbers) -> Numbers:
    """Return the place of the robot. Shapes of rows: (n, elements), of goals and the result: (n, size)."""
    sign, part = source[1], read_part(source, rows, goals.shape[1])
    return goals - sign * part if sign else part


def read_part(source: Source, rows: Numbers, size: int) -> Numbers:
    """Return what an observation has there: a place, or the way to the goal. Shapes (n, elements) and (n, size)."""
    element, _, *others = source
    part = rows[:, element : element + size]
    return part - rows[:, others[0] : others[0] + size] if others else part
