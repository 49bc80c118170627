"""The experiment `goals`: finds a goal that reset draws and the observation shows, for rules about rewards."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from rlctl.checking.drawn_goals import (
    TURNED,
    DrawnGoal,
    DrawnPlace,
    Numbers,
    SeenPose,
    Source,
    find_sources,
    read_place,
)
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, JudgeHook, experiment
from rlctl.checking.experiments.episodes import EPISODES
from rlctl.checking.experiments.starts import FIRST, STARTS
from rlctl.checking.goal_episodes import ROUNDING, TURN_SHIFT, GoalTrials
from rlctl.checking.instance import Context, Instance
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage, Fact
from rlctl.checking.rule import NotApplicable, NotJudged
from rlctl.checking.term_names import is_about_goals
from rlctl.checking.transitions import flatten_floats
from rlctl.checking.values import Attribute, read_attributes
from rlctl.checking.workspaces import Reach, find_chains, measure_reach

SIZES = (1, 2, 3)  # of a place [numbers]
MOST_CANDIDATES = 6
MOST_PARTS = 3  # elements of a goal, each of which may be one by itself, such as the angle of a door
STEPS = 3  # in which a goal does not change
SHIFT = np.array([0.013, -0.021, 0.034])  # of a goal, to see what of the observation follows it
PART = 5e-7  # of observations, that float32 rounds
MOST_NOISE = 2e-4  # of elements, from an episode to the same one again
COMPARED = 4  # resets after which the places of links are compared with the observation
SMALLER_UNITS = (100.0, 1000.0)  # times as many of them [cm, mm]
SCALED_GOAL = "goal in a smaller unit"
NEAR = 2e-3  # how near they are [m]
SAME_ANGLE = 2e-7  # of numbers near 1, that float32 rounds
TURN_ERROR = 1e-3  # of a turn that the observation has
LEAST_SCALE, SCALED_ROUNDING = 1e-3, 2e-7  # of a way in the observation, and what float32 makes of it


@dataclasses.dataclass(frozen=True)
class ScaledGoal:
    """A place that each reset draws, and that the observation has in a smaller unit: the fact `SCALED_GOAL`."""

    name: str  # of the attribute
    element: int  # of the observation, from which on it has the place
    factor: float
    size: float  # of what is observed there


judges_goals = JudgeHook[GoalTrials]()
"""Shows an instance with a goal that can be moved."""


@experiment("goals", PROBE, 110, share=0.5, hooks=(judges_goals,), seeds_globals=True, alters=True)
def find_goals(context: Context) -> Iterator[ChildMessage]:
    """Find an attribute that is drawn at reset and stays, and the parts of the observation that follow it."""
    instance = context.instance
    if not instance.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    places, by_chance = find_places(instance)
    drawn = find_drawn_goal(context, places)
    if drawn is not None:
        yield Fact("goals", drawn)
        yield from judges_goals.judge(GoalTrials(instance, drawn))
        return
    yield from _find_scaled(instance, places)
    if by_chance:
        raise NotJudged("the seed does not determine what reset draws (RL301)")
    raise NotApplicable("the observation follows no attribute that reset draws")


def find_drawn_goal(context: Context, places: Sequence[DrawnPlace]) -> DrawnGoal | None:
    """Return the first of some drawn places that the observation follows."""
    instance = context.instance
    for place in places:
        copies, scales = find_copies(instance, place), _find_turned(instance, place)
        turned = [(element, TURNED) for element in scales]
        pose = None if copies or turned else _find_pose(instance, place)
        if pose is not None:
            place = dataclasses.replace(place, is_pose=True)
            turned = [(_observe(instance, place, 0.0).size, TURNED)]
        if copies or turned:
            goals: dict[int, list[float]] = {}
            for seed in [*range(FIRST_SEED, FIRST_SEED + len(EPISODES)), *range(FIRST, FIRST + STARTS)]:
                if context.budget.why_spent():
                    break
                instance.reset(seed)
                goals[seed] = place.read(instance.env).tolist()
            if not goals:
                raise NotJudged(context.budget.why_spent())
            return DrawnGoal(place, copies, turned, goals, _find_reaches(instance, place, copies), scales, pose)
    return None


def _find_scaled(instance: Instance, places: Sequence[DrawnPlace]) -> Iterator[Fact]:
    """Yield the first attribute that the observation shows in a smaller unit."""
    for place in places:
        for factor in SMALLER_UNITS:
            if copies := find_copies(instance, place, factor):
                seen = _observe(instance, place, 0.0)[copies[0][0] :][: place.size]
                yield Fact(SCALED_GOAL, ScaledGoal(place.name, copies[0][0], factor, float(np.linalg.norm(seen))))
                return


def find_places(instance: Instance) -> tuple[list[DrawnPlace], list[str]]:
    """Return the places in attributes that a reset draws by its seed and no step changes, and the names of the others
    that it draws."""
    found = find_drawn(instance, _list_places)
    candidates = sorted(found.stays, key=lambda name: (not is_about_goals(name), found.sizes[name] not in SIZES, name))[
        :MOST_CANDIDATES
    ]
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
    parts = [DrawnPlace(one.name, (element,), is_part=True) for element in drawn[:MOST_PARTS] if size > 1]
    parts = parts if is_about_goals(one.name) else []
    if len(drawn) not in SIZES or len(drawn) < min(2, size):
        return parts
    found = [DrawnPlace(one.name, tuple(range(size)))] if size in SIZES else []
    if len(drawn) < size:
        found.append(DrawnPlace(one.name, drawn))
    return [*found, *parts]


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


def _find_pose(instance: Instance, place: DrawnPlace) -> SeenPose | None:
    """Return where the observation has the way to a place, turned or not, and the cosine and the sine of the angle to
    the last number of a goal."""
    size = place.size - 1
    plain = _observe(instance, place, 0.0)
    shifted = [_observe(instance, place, 1.0, TURN_SHIFT * axis) for axis in np.eye(place.size)]
    if size < 1 or not plain.size or any(row.shape != plain.shape for row in shifted):
        return None
    changes = np.stack([row - plain for row in shifted]) / TURN_SHIFT  # shape (size + 1, elements)
    rounding = TURN_ERROR + SAME_ANGLE * np.abs(plain).max() / TURN_SHIFT

    def is_way(element: int) -> bool:
        part = changes[:, element : element + size]
        is_rotation = np.abs(part[:size] @ part[:size].T - np.eye(size)).max() < rounding
        return bool(is_rotation and np.abs(part[size]).max() < rounding)

    def is_angle(cosine: int, sine: int) -> bool:
        rows = np.array([plain, *shifted])
        if np.abs(np.hypot(rows[:, cosine], rows[:, sine]) - 1.0).max() > TURN_ERROR:
            return False
        turns = np.diff(np.unwrap(np.arctan2(rows[[0, -1]][:, sine], rows[[0, -1]][:, cosine]))) / TURN_SHIFT
        is_own = np.abs(changes[:size, [cosine, sine]]).max() < rounding
        return bool(is_own and abs(abs(turns[0]) - 1.0) < rounding)

    ways = [element for element in range(plain.size - size + 1) if is_way(element)]
    pairs = [(i + 1 - k, i + k) for i in range(plain.size - 1) for k in (1, 0)]
    angles = [pair for pair in pairs if is_angle(*pair)]
    # The order of cosine and sine does not show in one pair: the angle is 0 where the cosine is 1.
    return SeenPose(ways[0], size, *angles[0]) if ways and angles else None


def _observe(instance: Instance, place: DrawnPlace, shift: float, along: Numbers = SHIFT) -> Numbers:
    """Return the observation of the first step if the place is shifted before it. Shape (elements,)."""
    episode = EpisodePlayer(instance, FIRST_SEED, "zero", max_steps=1)
    episode.reset()
    attribute = place.find(instance.env)
    place.assign(attribute, place.pick(attribute) + shift * along[: place.size])
    return flatten_floats(instance.leaves, episode.step().observation)


def _find_reaches(instance: Instance, place: DrawnPlace, copies: Sequence[Source]) -> dict[Source, Reach]:
    """Return how far the links of fixed robots get whose places are observed, by where they are observed."""
    if not place.is_place:  # a single number says too little of a place
        return {}
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
