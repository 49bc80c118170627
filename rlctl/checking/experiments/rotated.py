"""The experiment `rotated`: turns the world of a robot about the vertical, for rules about headings.

The robot is written in NumPy, and its world is what its attributes hold; or it turns about a hinge on the world of an
engine. Nothing but the direction is another one then: what is observed in the frame of the robot stays the same, and
vectors in the axes of the world turn.
"""

import dataclasses
import functools
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, JudgeHook, experiment
from rlctl.checking.hinged_bases import HingedBase, find_hinged_base, has_engine
from rlctl.checking.instance import Context, Instance
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged
from rlctl.checking.transitions import find_float_leaves, flatten_floats
from rlctl.checking.values import Attribute, find_unequal, read_attributes, shape_like

STEPS = 5  # of an episode
ANGLES = (0.0, 0.9, 2.1, 3.7, 5.1)  # [rad]
FULL_TURN = 2 * np.pi
MOST_ANGLES, MOST_VECTORS = 24, 40  # attributes that are tried
SAME = 1e-6  # of numbers an angle and a whole turn apart, part of their size or of 1
EXPLAINED = 0.08  # part of an element's size that turning may leave: friction and gusts have directions
USUAL_EPISODES, USUAL_STEPS = 3, 40  # that tell the size of elements
CLEARLY = 4.0  # how many times more another kind leaves
CONSTANT, CONSTANT_PART = 0.08, 0.3  # parts of it, and of what turns of it, that may not turn: noise
UNIT = 1e-4  # how far a quaternion may be from the length 1
LEAST_SIZE = 1e-3  # of elements
SEEDS = 6  # that a rule compares
PAIRED = (("x", "y"), ("px", "py"), ("vx", "vy"), ("x_pos", "y_pos"), ("x_dot", "y_dot"))
REWARD_WEIGHT = 1e-3
TIE = 1e-5  # of misfits
Numbers = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class Part:
    """Numbers of attributes that turn with the world."""

    name: str
    axes: tuple[tuple[str, int], ...]  # Attribute and place of each number: x and y in turn, or one angle [rad]
    is_heading: bool = False  # whether it is an orientation: an angle, a quaternion or a matrix
    speed: float = 1.0  # by how many times the angle it turns: half of it in a quaternion

    @property
    def is_angle(self) -> bool:
        """Whether it is an angle, and no vectors."""
        return len(self.axes) == 1

    def read_heading(self, attributes: Mapping[str, Attribute]) -> float:
        """Return the heading that it is [rad]."""
        numbers = [float(attributes[name].numbers[place]) for name, place in self.axes]
        if self.is_angle:
            return numbers[0]
        if self.speed == 1.0:  # the first column of a matrix
            return float(np.arctan2(numbers[1], numbers[0]))
        w, z, x, y = numbers
        return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


@dataclasses.dataclass(frozen=True, eq=False)
class TurnedEpisode:
    """What a few steps return after the world was turned."""

    headings: Numbers  # of the robot after each step [rad]. Shape (steps,)
    observed: Numbers  # Shape (steps, elements)
    rewards: Numbers  # Shape (steps,)


@dataclasses.dataclass(frozen=True, eq=False)
class Turning:
    """How elements of the observation turn with the world, by the same episode at several angles.

    Elements are of one kind at most. Shapes (elements,), and of what is per step (steps, elements).
    """

    amplitudes: Numbers  # per step, of components of vectors in the axes of the world
    phases: Numbers  # of the same, per step [rad]
    stays: Flags
    turns: Flags  # is such a component
    is_clear: Flags  # whether nothing else than its kind fits nearly as well
    doubles: Flags  # turns twice as far
    shows: Flags  # is the angle itself, or of a quaternion
    left: Numbers  # of each element, part of its size, by the best of these kinds
    episodes: Sequence[TurnedEpisode]  # at each angle

    @property
    def is_explained(self) -> bool:
        """Whether each element is of one of the kinds."""
        return bool((self.stays | self.turns | self.doubles | self.shows).all())

    @property
    def misfit(self) -> float:
        """How much of the observation does not follow, and a little of the reward."""
        rewards = np.array([episode.rewards for episode in self.episodes if len(episode.rewards) == self.steps])
        off = float(np.ptp(rewards, axis=0).max(initial=0.0)) if len(rewards) == len(ANGLES) else np.inf
        size = float(np.abs(rewards).max(initial=LEAST_SIZE))
        return float(np.minimum(self.left, 1.0).sum()) + REWARD_WEIGHT * min(1.0, off / size)

    @property
    def steps(self) -> int:
        """How many steps all episodes have."""
        return len(self.amplitudes)


@dataclasses.dataclass(frozen=True, eq=False)
class RotatedRobot:
    """A robot whose world can be turned about the vertical."""

    instance: Instance
    parts: tuple[Part, ...]  # that turn
    heading: Part | HingedBase
    turning: Turning  # with the first seed
    usual: Numbers  # how large each element is. Shape (elements,)

    @property
    def heading_name(self) -> str:
        """What the heading is called."""
        return self.heading.name

    @functools.cached_property
    def turnings(self) -> list[Turning]:
        """How the observation turns, with several seeds; fewer where time is over."""
        found = [self.turning]
        for number in range(1, SEEDS):
            if self.instance.context.budget.is_over():
                break
            found.append(_turn_all(self.instance, number, self.parts, self.heading, self.usual))
        return found


judges_rotated = JudgeHook[RotatedRobot]()
"""Shows a robot whose world turns with it."""


@experiment("rotated", PROBE, 113, share=0.4, hooks=(judges_rotated,))
def rotate_world(context: Context) -> Iterator[ChildMessage]:
    """Find which attributes turn with the world of a robot, and let the rules look at what it observes then."""
    instance = context.instance
    if not instance.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    _play(instance, 0, (), None, 0.0)  # an instance's first episode may differ from all others
    base = find_hinged_base(instance)
    if base is None and has_engine(instance):
        raise NotApplicable("no robot that turns about a hinge on the world, or without an engine")
    first = _play(instance, 0, (), None, 0.0)
    if not _are_same(first, _play(instance, 0, (), None, 0.0)) or not first.observed.size:
        raise NotJudged("an episode with the same seed and actions is not the same again (RL302)")
    vectors = _find_vectors(instance)
    angles = [] if base is not None else _find_angles(instance, first)
    if base is None and not angles and not any(part.is_heading for part in vectors):
        raise NotApplicable("no attribute is the heading of a robot")
    usual = _measure_elements(instance)
    parts, turning = _choose(instance, [*angles, *vectors], base, usual)
    headings = [part for part in parts if part.is_heading]
    if not turning.is_explained or (base is None and not headings):
        raise NotApplicable("the world of the robot cannot be turned about the vertical")
    yield from judges_rotated.judge(RotatedRobot(instance, parts, base or headings[0], turning, usual))


def _play(
    instance: Instance,
    number: int,
    parts: Collection[Part],
    heading: Part | HingedBase | None,
    angle: float,
    steps: int = STEPS,
) -> TurnedEpisode:
    """Reset, turn parts by an angle [rad], and the base that the heading is, and take a few steps."""
    if instance.context.budget.is_over():
        raise NotJudged("time ran out before the last comparison")
    player = EpisodePlayer(instance, FIRST_SEED + number, "random", number=number, max_steps=steps)
    player.reset()
    turned = _turn_parts(instance, parts, angle)
    if isinstance(heading, HingedBase):
        heading.turn(angle)
    headings, observed, rewards = [], [], []
    while not player.ended:
        moment = player.step()
        if not moment.is_readable:
            break
        headings.append(_read_heading(instance, heading))
        observed.append(flatten_floats(instance.leaves, moment.observation))
        rewards.append(moment.reward_number)
    for attribute in turned:  # a reset may not set them
        attribute.assign(attribute.value)
    size = observed[0].size if observed else 0
    rows = np.stack([row for row in observed if row.size == size]) if size else np.zeros((len(observed), 0))
    return TurnedEpisode(np.array(headings), np.nan_to_num(rows), np.array(rewards))


def _measure_elements(instance: Instance) -> Numbers:
    """Return how large each element is in some episodes, or the one before or after it, which may be of the same
    vector. Shape (elements,)."""
    episodes = [_play(instance, number, (), None, 0.0, USUAL_STEPS) for number in range(USUAL_EPISODES)]
    sizes = np.sqrt(np.mean(np.square(np.concatenate([episode.observed for episode in episodes])), axis=0))
    ends = np.cumsum([np.prod(instance.leaves[leaf].shape, dtype=int) for leaf in find_float_leaves(instance.leaves)])
    parts = [np.pad(part, 1) for part in np.split(sizes, ends[:-1])]
    return np.concatenate([np.max([part[:-2], part[1:-1], part[2:]], axis=0) for part in parts])


def _read_heading(instance: Instance, heading: Part | HingedBase | None) -> float:
    if isinstance(heading, HingedBase):
        return heading.read()
    return 0.0 if heading is None else heading.read_heading(read_attributes(instance.env))


def _turn_parts(instance: Instance, parts: Collection[Part], angle: float) -> list[Attribute]:
    """Turn parts by an angle [rad]; return the attributes that have another value now, with the one before."""
    if not angle or not parts:
        return []
    attributes = read_attributes(instance.env)
    numbers = {name: attributes[name].numbers.copy() for part in parts for name, _ in part.axes if name in attributes}
    for part in parts:
        turn = np.exp(1j * part.speed * angle)
        if any(name not in numbers or place >= numbers[name].size for name, place in part.axes):
            continue
        if part.is_angle:
            name, place = part.axes[0]
            numbers[name][place] += angle
            continue
        for (one, x), (two, y) in zip(part.axes[::2], part.axes[1::2], strict=True):
            vector = turn * complex(numbers[one][x], numbers[two][y])
            numbers[one][x], numbers[two][y] = vector.real, vector.imag
    for name, values in numbers.items():
        attributes[name].assign(shape_like(attributes[name].value, values))
    return [attributes[name] for name in numbers]


def _find_angles(instance: Instance, plain: TurnedEpisode) -> list[Part]:
    """Return the numbers that may be a whole turn larger and change nothing then, but matter."""
    found = []
    places = [
        Part(name if one.numbers.size == 1 else f"{name}[{place}]", ((name, place),), is_heading=True)
        for name, one in _read_states(instance).items()
        if one.numbers.size <= MOST_ANGLES
        for place in range(one.numbers.size)
    ]
    for part in places[: 2 * MOST_VECTORS]:
        whole = _play(instance, 0, [part], None, FULL_TURN)
        if _are_same(plain, whole, up_to_turns=True) and not _are_same(plain, _play(instance, 0, [part], None, 1.0)):
            found.append(part)
    return found[:MOST_ANGLES]


def _read_states(instance: Instance) -> dict[str, Attribute]:
    """Return the attributes with numbers that are no counts, and that resets or steps change."""
    looks = []
    for number in range(2):
        player = EpisodePlayer(instance, FIRST_SEED + number, "random", number=number, max_steps=STEPS)
        looks += [read_attributes(instance.env) for _ in player]
    changing = {name for look in looks[1:] for name in find_unequal(looks[0], look)}
    return {
        name: one for name, one in looks[-1].items() if name in changing and np.asarray(one.value).dtype.kind == "f"
    }


def _are_same(one: TurnedEpisode, two: TurnedEpisode, *, up_to_turns: bool = False) -> bool:
    if one.observed.shape != two.observed.shape or one.rewards.shape != two.rewards.shape:
        return False
    off = np.abs(one.observed - two.observed)
    if up_to_turns:  # the angle itself may be observed
        off = np.minimum(off, np.abs(off - FULL_TURN))
    size = max(1.0, float(np.abs(one.rewards).max(initial=0.0)))
    is_same_reward = np.nan_to_num(np.abs(one.rewards - two.rewards)).max(initial=0.0) <= SAME * size
    return bool((off <= SAME * np.maximum(1.0, np.abs(one.observed))).all() and is_same_reward)


def _find_vectors(instance: Instance) -> list[Part]:
    """Return what may be vectors in the axes of the world: rows of two or three numbers, and x and y by their names."""
    attributes = _read_states(instance)
    found: list[Part] = []
    for name, attribute in attributes.items():
        found += _list_parts(name, np.asarray(attribute.value, np.float64))
    for name in attributes:
        for one, two in PAIRED:
            other = name[: -len(one)] + two
            is_scalar = attributes[name].numbers.size == 1
            if name.endswith((f".{one}", f"_{one}")) and other in attributes and is_scalar:
                found.append(Part(name, ((name, 0), (other, 0))))
    return found[:MOST_VECTORS]


def _list_parts(name: str, values: Numbers) -> Iterator[Part]:
    """Yield what may turn of the values of an attribute: a matrix, a quaternion, rows of two or three numbers, or pairs
    of numbers."""
    shape = values.shape
    if shape == (3, 3) and np.allclose(values @ values.T, np.eye(3), atol=UNIT):
        yield Part(name, tuple((name, column + 3 * axis) for column in range(3) for axis in (0, 1)), True)
    elif shape == (4,) and abs(np.linalg.norm(values) - 1) < UNIT:
        for w, x, y, z in ((0, 1, 2, 3), (3, 0, 1, 2)):
            yield Part(name, ((name, w), (name, z), (name, x), (name, y)), True, 0.5)
    elif shape and shape[-1] in (2, 3):
        firsts = range(0, values.size, shape[-1])
        yield Part(name, tuple((name, first + axis) for first in firsts for axis in (0, 1)))
    elif len(shape) == 1:
        for first in range(values.size - 1):
            yield Part(f"{name}[{first}]", ((name, first), (name, first + 1)))


def _choose(
    instance: Instance, parts: Sequence[Part], base: HingedBase | None, usual: Numbers
) -> tuple[tuple[Part, ...], Turning]:
    """Return the parts that have to turn together, so that as much as possible of the observation follows, and how; as
    few as do."""
    chosen: list[Part] = []
    for part in parts:
        if not _overlaps(part, chosen):
            chosen.append(part)
    best = _turn_all(instance, 0, chosen, base, usual)
    improves = True
    while improves:
        improves = False
        for part in parts:
            if part in chosen:
                change = [one for one in chosen if one is not part]
            else:
                change = [*(one for one in chosen if not _overlaps(one, [part])), part]
            if base is None and not any(one.is_heading for one in change):
                continue
            turning = _turn_all(instance, 0, change, base, usual)
            is_fewer = len(change) < len(chosen)
            if turning.misfit < best.misfit - TIE or (is_fewer and turning.misfit < best.misfit + TIE):
                best, chosen, improves = turning, change, True
    return tuple(chosen), best


def _overlaps(part: Part, parts: Sequence[Part]) -> bool:
    return any(set(part.axes) & set(other.axes) for other in parts if other is not part)


def _turn_all(
    instance: Instance, number: int, parts: Collection[Part], heading: Part | HingedBase | None, usual: Numbers
) -> Turning:
    """Play the same episode with its world turned by all angles; `usual` has how large each element is."""
    headings = heading or next((part for part in parts if part.is_heading), None)
    return _compare([_play(instance, number, parts, headings, angle) for angle in ANGLES], usual)


def _compare(episodes: Sequence[TurnedEpisode], usual: Numbers) -> Turning:
    steps = min(len(episode.observed) for episode in episodes)
    rows = np.stack([episode.observed[:steps] for episode in episodes])  # Shape (angles, steps, elements)
    size = np.maximum(LEAST_SIZE, np.maximum(usual, np.abs(rows[0]).max(axis=0, initial=0.0)))
    angles = np.array(ANGLES)

    def fit(speed: float) -> tuple[Numbers, Numbers]:
        """Return the weights of a cosine and a sine, and what is left of each element."""
        one = np.stack([np.cos(speed * angles), np.sin(speed * angles), np.ones_like(angles)], axis=1)
        flat = rows.reshape(len(angles), -1)
        weights = np.linalg.lstsq(one, flat, rcond=None)[0]
        shape = (-1, *rows.shape[1:])
        left = np.abs(flat - one @ weights).reshape(shape).max(axis=(0, 1), initial=0.0) / size
        constant = np.abs(weights[2]).reshape(rows.shape[1:]).max(axis=0, initial=0.0)  # such as noise
        amplitude = np.hypot(weights[0], weights[1]).reshape(rows.shape[1:]).max(axis=0, initial=0.0)
        is_turned = constant <= np.minimum(CONSTANT * size, CONSTANT_PART * amplitude)
        return weights.reshape(shape), np.where(is_turned, left, 1.0)

    weights, turned = fit(1.0)
    added = np.abs((rows - rows[:1] - angles[:, None, None] + np.pi) % FULL_TURN - np.pi)
    stayed = np.abs(rows - rows[:1])
    off = [one.max(axis=(0, 1), initial=0.0) / size for one in (stayed, added)]
    lefts = np.stack([off[0], turned, fit(2.0)[1], off[1], fit(0.5)[1]])
    kinds = np.where(lefts.min(axis=0, initial=1.0) <= EXPLAINED, lefts.argmin(axis=0), -1)
    return Turning(
        amplitudes=np.hypot(weights[0], weights[1]),
        phases=np.arctan2(weights[1], weights[0]),
        stays=kinds == 0,
        turns=kinds == 1,
        is_clear=np.sort(lefts, axis=0)[1] > CLEARLY * lefts.min(axis=0),
        doubles=kinds == 2,
        shows=kinds >= 3,
        left=lefts.min(axis=0, initial=1.0),
        episodes=episodes,
    )
