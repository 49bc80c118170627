"""How elements of the observation turn with the world of a robot."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

ANGLES = (0.0, 0.9, 2.1, 3.7, 5.1)  # [rad]
FULL_TURN = 2 * np.pi
EXPLAINED = 0.08  # part of an element's size that turning may leave: friction and gusts have directions
CLEARLY = 4.0  # how many times more another kind leaves
CONSTANT, CONSTANT_PART = 0.08, 0.3  # parts of it, and of what turns of it, that may not turn: noise
LEAST_SIZE = 1e-3  # of elements
REWARD_WEIGHT = 1e-3
Numbers = NDArray[np.float64]
Flags = NDArray[np.bool_]


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
    def common(self) -> list[TurnedEpisode]:
        """The episodes up to the step at which the first of them ends, as where a turned robot is at its goal."""
        return [
            TurnedEpisode(one.headings[: self.steps], one.observed[: self.steps], one.rewards[: self.steps])
            for one in self.episodes
        ]

    @property
    def is_explained(self) -> bool:
        """Whether there are steps, and each element is of one of the kinds."""
        return self.steps > 0 and bool((self.stays | self.turns | self.doubles | self.shows).all())

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


def compare_episodes(episodes: Sequence[TurnedEpisode], usual: Numbers) -> Turning:
    """Return how elements turn, by the same episode at all angles; `usual` has how large each element is."""
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
        constant = np.sqrt(np.square(weights[2]).reshape(rows.shape[1:]).mean(axis=0))  # such as noise
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
