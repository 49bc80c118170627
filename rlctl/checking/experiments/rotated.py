"""The experiment `rotated`: turns the world of a robot about the vertical, for rules about headings.

The robot is written in NumPy, and its world is what its attributes hold; or it turns about a hinge on the world of an
engine. Nothing but the direction is another one then: what is observed in the frame of the robot stays the same, and
vectors in the axes of the world turn.
"""

import dataclasses
import functools
import itertools
from collections.abc import Collection, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, JudgeHook, experiment
from rlctl.checking.hinged_bases import HingedBase, find_hinged_base, has_engine
from rlctl.checking.instance import Context, Instance
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged
from rlctl.checking.transitions import find_float_leaves, flatten_floats
from rlctl.checking.turning_parts import TurningPart, find_vectors, overlaps, turn_parts
from rlctl.checking.turnings import ANGLES, FULL_TURN, TurnedEpisode, Turning, compare_episodes
from rlctl.checking.values import Attribute, find_unequal, read_attributes

STEPS = 5  # of an episode
MOST_ANGLES, MOST_TRIED = 24, 80  # attributes that may be angles, and that are tried
SAME, SAME_IN_FLOAT32 = 1e-6, 1e-4  # of numbers an angle and a whole turn apart, part of their size or of 1
USUAL_EPISODES, USUAL_STEPS = 3, 40  # that tell the size of elements
SEEDS = 6  # that a rule compares
TIE = 1e-5  # of misfits
Numbers = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class RotatedRobot:
    """A robot whose world can be turned about the vertical."""

    instance: Instance
    parts: tuple[TurningPart, ...]  # that turn
    heading: TurningPart | HingedBase
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


@experiment("rotated", PROBE, 115, share=0.4, hooks=(judges_rotated,), seeds_globals=True, alters=True)
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
    if not first.observed.size:
        raise NotApplicable("nothing that is observed is a real number")
    if not _are_same(first, _play(instance, 0, (), None, 0.0)):
        raise NotJudged("an episode with the same seed and actions is not the same again (RL302)")
    vectors = find_vectors(_read_states(instance))
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
    parts: Collection[TurningPart],
    heading: TurningPart | HingedBase | None,
    angle: float,
    steps: int = STEPS,
) -> TurnedEpisode:
    """Reset, turn parts by an angle [rad], and the base that the heading is, and take a few steps."""
    if instance.context.budget.is_over():
        raise NotJudged("time ran out before the last comparison")
    player = EpisodePlayer(instance, FIRST_SEED + number, "random", number=number, max_steps=steps)
    player.reset()
    turned = turn_parts(instance, parts, angle)
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


def _read_heading(instance: Instance, heading: TurningPart | HingedBase | None) -> float:
    if isinstance(heading, HingedBase):
        return heading.read()
    return 0.0 if heading is None else heading.read_heading(read_attributes(instance.env))


def _find_angles(instance: Instance, plain: TurnedEpisode) -> list[TurningPart]:
    """Return the numbers that may be a whole turn larger and change nothing then, but matter."""
    found = []
    states = _read_states(instance)
    places = [
        TurningPart(name if one.numbers.size == 1 else f"{name}[{place}]", ((name, place),), is_heading=True)
        for name, one in states.items()
        if one.numbers.size <= MOST_ANGLES
        for place in range(one.numbers.size)
    ]
    for part in places[:MOST_TRIED]:
        is_double = np.asarray(states[part.axes[0][0]].value).dtype.itemsize > np.dtype(np.float32).itemsize
        same = SAME if is_double else SAME_IN_FLOAT32
        whole = _play(instance, 0, [part], None, FULL_TURN)
        is_angle = _are_same(plain, whole, same, up_to_turns=True)
        if is_angle and not _are_same(plain, _play(instance, 0, [part], None, 1.0), same):
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


def _are_same(one: TurnedEpisode, two: TurnedEpisode, same: float = SAME, *, up_to_turns: bool = False) -> bool:
    if one.observed.shape != two.observed.shape or one.rewards.shape != two.rewards.shape:
        return False
    off = np.abs(one.observed - two.observed)
    if up_to_turns:  # the angle itself may be observed
        off = np.minimum(off, np.abs(off - FULL_TURN))
    size = max(1.0, float(np.abs(one.rewards).max(initial=0.0)))
    is_same_reward = np.nan_to_num(np.abs(one.rewards - two.rewards)).max(initial=0.0) <= same * size
    return bool((off <= same * np.maximum(1.0, np.abs(one.observed))).all() and is_same_reward)


def _choose(
    instance: Instance, parts: Sequence[TurningPart], base: HingedBase | None, usual: Numbers
) -> tuple[tuple[TurningPart, ...], Turning]:
    """Return the parts that have to turn together, so that as much as possible of the observation follows, and how; as
    few as do."""
    chosen: list[TurningPart] = []
    for part in parts:
        if not overlaps(part, chosen):
            chosen.append(part)
    best = _turn_all(instance, 0, chosen, base, usual)
    improves = True
    while improves:
        improves = False
        for part in parts:
            if part in chosen:
                change = [one for one in chosen if one is not part]
            else:
                change = [*(one for one in chosen if not overlaps(one, [part])), part]
            if base is None and not any(one.is_heading for one in change):
                continue
            turning = _turn_all(instance, 0, change, base, usual)
            is_fewer = len(change) < len(chosen)
            if turning.misfit < best.misfit - TIE or (is_fewer and turning.misfit < best.misfit + TIE):
                best, chosen, improves = turning, change, True
    return _complete(instance, parts, base, usual, chosen, best)


def _complete(
    instance: Instance,
    parts: Sequence[TurningPart],
    base: HingedBase | None,
    usual: Numbers,
    chosen: Sequence[TurningPart],
    best: Turning,
) -> tuple[tuple[TurningPart, ...], Turning]:
    """Return the parts with those added with which less of the observation turns: what the robot sees in its own frame
    turns where it is turned without them."""
    rest = [part for part in parts if part not in chosen and not overlaps(part, chosen)]
    for size in (1, 2):
        for more in itertools.combinations(rest, size):
            if not best.is_explained or not best.turns.any():
                return tuple(chosen), best
            if set(more) & set(chosen) or any(overlaps(part, more) for part in more):
                continue
            turning = _turn_all(instance, 0, [*chosen, *more], base, usual)
            if turning.is_explained and turning.turns.sum() < best.turns.sum():
                best, chosen = turning, [*chosen, *more]
    return tuple(chosen), best


def _turn_all(
    instance: Instance,
    number: int,
    parts: Collection[TurningPart],
    heading: TurningPart | HingedBase | None,
    usual: Numbers,
) -> Turning:
    """Play the same episode with its world turned by all angles; `usual` has how large each element is."""
    headings = heading or next((part for part in parts if part.is_heading), None)
    return compare_episodes([_play(instance, number, parts, headings, angle) for angle in ANGLES], usual)
