"""Whether the reward rises as the robot leaves the object that it has to bring to the goal."""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.drawn_goals import Source
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.goal_episodes import PLACED_STEPS, GoalEpisode, GoalTrials
from rlctl.checking.points import PointReader
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.values import flatten_action

KINDS = ("random", "repeated", "extreme", "random", "repeated", "extreme")
STEPS, FEWEST_STEPS = 60, 60  # of an episode at most; those that are judged
EPISODES = 3  # in which the object is looked for
SAME, RESTS, MOVES = 1e-3, 1e-4, 2e-2  # parts of the goals' range: the same place; what rests, and what moves
PARTLY = 0.5  # the same, of one of two points
SURE = 0.9  # correlation with the distance, of what the action does not explain of the reward
Numbers = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Leaving:
    """What pays for being away from an object."""

    point: str  # of the robot
    item: str  # the object
    slope: float  # of the reward by the distance, or by its change in a step
    is_change: bool
    steps: int


@dataclasses.dataclass(frozen=True)
class _LeavingStep:
    reward: float
    action: Numbers
    change: Numbers  # of the action
    before: Mapping[str, Numbers]
    after: Mapping[str, Numbers]


def find_leaving(trials: GoalTrials, source: Source) -> Leaving | None:
    """Return what in a robot is paid for its distance from an object, where the object, read by `source`, has to be at
    the goal; None where that costs, pays nothing, or nothing has to be brought."""
    items = [] if trials.drawn.place.is_part else _find_items(trials, source)
    looks = list(_play(trials)) if items else []
    span = float(np.linalg.norm(trials.range))
    for item in items:
        resting = [look for look in looks if item in look.after and _is_at_rest(look, item, span)]
        if len(resting) >= FEWEST_STEPS:
            return _fit(resting, item, items, span)
    return None


def _is_at_rest(look: _LeavingStep, item: str, span: float) -> bool:
    return bool(np.linalg.norm(look.after[item] - look.before[item]) < RESTS * span)


def _find_items(trials: GoalTrials, source: Source) -> list[str]:
    """Return the points that are at the place of a source."""
    span = float(np.linalg.norm(trials.range))
    common: set[str] | None = None
    for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
        episode = GoalEpisode(trials, seed, "repeated", PLACED_STEPS)
        points = PointReader(trials.instance, trials.drawn.place.axes).read()
        place = episode.read(source)[: len(trials.drawn.place.axes)]
        near = {name for name, point in points.items() if np.linalg.norm(point - place) < SAME * span}
        common = near if common is None else common & near
    return sorted(common or ())


def _play(trials: GoalTrials) -> Iterator[_LeavingStep]:
    instance = trials.instance
    for number, kind in enumerate(KINDS):
        episode = EpisodePlayer(instance, FIRST_SEED + number, kind, max_steps=STEPS)
        episode.reset()
        reader = PointReader(instance, trials.drawn.place.axes)
        before, earlier = reader.read(), None
        while not episode.ended:
            moment = episode.step()
            after, action = reader.read(), flatten_action(instance.action_leaves, moment.action)
            change = np.zeros(action.size) if earlier is None else action - earlier
            if not any(moment.flags):
                yield _LeavingStep(moment.reward_number, action, change, before, after)
            before, earlier = after, action


def _fit(looks: list[_LeavingStep], item: str, items: list[str], span: float) -> Leaving | None:
    """Return the point whose distance explains most of what the actions leave of the rewards, if more pays more."""
    rewards = np.array([look.reward for look in looks])
    actions, changes = np.array([look.action for look in looks]), np.array([look.change for look in looks])
    columns = np.hstack([np.ones((len(looks), 1)), actions, np.square(actions), np.square(changes)])
    left = _remove(columns, rewards)
    if not np.isfinite(left).all() or np.linalg.norm(left) <= 1e-9 * max(1.0, float(np.abs(rewards).max())):
        return None

    def relate(names: Sequence[str]) -> Iterator[tuple[float, Leaving]]:
        """Yield how the rewards go with the sum of the distances of some points, and with its changes."""
        after = sum((_measure(looks, name, item, "after") for name in names), np.zeros(len(looks)))
        before = sum((_measure(looks, name, item, "before") for name in names), np.zeros(len(looks)))
        for is_change, column in ((True, after - before), (False, after)):
            rest = _remove(columns, column)
            size = float(rest @ rest)
            if np.ptp(after) >= MOVES * span and size > 1e-12 * float(column @ column):
                correlation = float(rest @ left) / float(np.sqrt(size) * np.linalg.norm(left))
                slope = float(rest @ left) / size
                yield correlation, Leaving(" and ".join(names), item, slope, is_change, len(looks))

    known = [name for name in looks[0].after if name not in items and _is_known(looks, name)]
    singles = [(name, found) for name in known for found in relate([name])]
    # A hand has two fingers, or more: each of them explains a part.
    parts = list(dict.fromkeys(name for name, found in singles if found[0] > PARTLY))
    fingers = [found for pair in itertools.combinations(parts, 2) for found in relate(pair)]
    for founds in ([found for _, found in singles], fingers):
        correlation, leaving = max(founds, key=lambda found: abs(found[0]), default=(0.0, None))
        if leaving is not None and abs(correlation) > SURE:
            return leaving if correlation > 0 else None
    return None


def _is_known(looks: Sequence[_LeavingStep], name: str) -> bool:
    return all(name in look.after and name in look.before for look in looks)


def _measure(looks: Sequence[_LeavingStep], name: str, item: str, when: str) -> Numbers:
    """Return how far a point is from the object `before` or `after` each step."""
    return np.array([np.linalg.norm(getattr(look, when)[name] - getattr(look, when)[item]) for look in looks])


def _remove(columns: Numbers, values: Numbers) -> Numbers:
    return values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]
