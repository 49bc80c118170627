"""Where around the place of a success the reward is highest, as the goal is moved there from far away."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.drawn_goals import Source
from rlctl.checking.goal_episodes import GoalEpisode, GoalTrials
from rlctl.checking.records import FIRST_SEED

FIRST_STEPS = 10  # with the action that the episode holds, so that the robot is somewhere else in each
FAR = 1.2  # parts of the goals' range: where the goal comes from
PARTS = (0.08, 0.16, 0.32, 0.64)  # the same, of the places that are compared, to both sides
FEWEST = 2  # places to a side that are no success
CLEARLY = 0.05  # part of the differences of rewards, by which a peak is higher
LEAST = 1e-6  # of the rewards: what is no difference
EPISODES, MOST_EPISODES = 3, 8
MOST = 0.5  # part of the episodes that have a peak
Numbers = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Peak:
    """A place that pays more than the one next to the success, and than all on the other side of it."""

    axis: int
    offset: float  # of the goal from where it is a success
    reward: float
    nearest: float  # the larger one of the rewards next to the success


def find_peaks(trials: GoalTrials, source: Source, room: Sequence[float]) -> list[Peak]:
    """Return a peak of each of some episodes, if most have one; empty otherwise. `room` is how far from the robot
    a goal may be put along each axis."""
    peaks: list[Peak] = []
    tried = 0
    for seed in range(FIRST_SEED, FIRST_SEED + MOST_EPISODES):
        if tried == EPISODES and not peaks:
            return []
        if GoalEpisode(trials, seed, "repeated", FIRST_STEPS).has_succeeded:
            continue
        tried += 1
        found = (_find_peak(trials, source, seed, axis, size) for axis, size in enumerate(room))
        if (peak := next((one for one in found if one is not None), None)) is not None:
            peaks.append(peak)
        if tried >= EPISODES and len(peaks) == tried:
            return peaks
    return peaks if len(peaks) >= max(EPISODES, MOST * tried) else []


def _find_peak(trials: GoalTrials, source: Source, seed: int, axis: int, room: float) -> Peak | None:
    sides: dict[float, list[tuple[float, float]]] = {}  # offsets and rewards, the nearest first, by the side
    for sign in (1.0, -1.0):
        offsets = [sign * part * room for part in PARTS]
        paid = [(offset, _pay(trials, source, seed, axis, (FAR * room, offset, offset))) for offset in offsets]
        sides[sign] = [(offset, reward) for offset, reward in paid if reward is not None]
    if min(len(side) for side in sides.values()) < FEWEST:
        return None
    rewards = np.array([reward for side in sides.values() for _, reward in side])
    at_goal = _pay(trials, source, seed, axis, (FAR * room, 0.0, 0.0), succeeds=True)
    least = max(CLEARLY * float(np.ptp(rewards)), LEAST * max(1.0, float(np.abs(rewards).max())))
    for sign, side in sides.items():
        number = int(np.argmax([reward for _, reward in side]))
        offset, reward = side[number]
        others = [other for _, other in [side[0], *sides[-sign]]]
        if number and reward > max(others) + least and (at_goal is None or reward > at_goal + least):
            return Peak(axis, offset, reward, max(side[0][1], sides[-sign][0][1]))
    return None


def _pay(
    trials: GoalTrials, source: Source, seed: int, axis: int, offsets: Sequence[float], *, succeeds: bool = False
) -> float | None:
    """Return what the steps after the first pay in which the goal is so far from the robot, which moves on as before:
    the way to the goal is then paid too where progress is. None if one is a success; or, if it `succeeds`, where one
    is none, or ends the episode."""
    episode = GoalEpisode(trials, seed, "repeated", FIRST_STEPS - 1)
    before = episode.read(source)
    episode.play([None])
    rewards: list[float] = []
    along = np.eye(before.size)[axis]
    for step, _ in episode.lead(source, before, (offset * along for offset in offsets)):
        if rewards and bool(step.succeeds) != succeeds:
            return None
        rewards.append(step.reward)
    if len(rewards) < len(offsets) or (succeeds and episode.has_ended):
        return None
    return float(sum(rewards[1:]))
