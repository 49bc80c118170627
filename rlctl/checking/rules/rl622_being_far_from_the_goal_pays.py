"""RL622: being far from the goal pays."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.experiments.goals import (
    MOST_SOURCES,
    GoalEpisode,
    GoalTrials,
    Numbers,
    Source,
    find_sources,
    judges_goals,
)
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names

RULE = Rule(
    "RL622",
    "being far from the goal pays",
    Severity.WARNING,
    meaning="""
        The further away the goal is, the larger is the reward, to both sides; or every failure pays more than
        success, which goes on. The check played the same steps again, and put the goal, or the command, where
        is_success is true, and at several distances from there. So the policy learns to keep away from the
        goal. Most often a sign is wrong, or an error is paid instead of a function that falls with it.
    """,
    fix="""
        Make the reward largest where the task is done: subtract the distance or the error, or pay
        exp(-error / scale).
    """,
)

FIRST_STEPS = 10  # with the action that the episode holds, so that the robot is somewhere else in each
LATER_STEPS = 2  # with the goal moved: the first may pay the way to it as progress
EPISODES, MOST_EPISODES = 3, 10  # that are needed, and that are tried
FEWEST_MOVED = 0.02  # part of the goals' range: how far apart the robot is in these episodes
RADII = (0.35, 0.7, 1.0)  # parts of the goals' range
LEAST = 1e-6  # differences of rewards that count, of their size


@dataclasses.dataclass(frozen=True)
class _Outcome:
    """What a goal gave that is as far from the robot as `offset`."""

    reward: float
    succeeds: bool
    has_ended: bool  # and how: by this step or one before
    place: Numbers  # of the robot


@judges_goals(RULE)
def _compare_goals(trials: GoalTrials) -> Iterator[ChildMessage]:
    """Put the goal where the robot is, and to either side."""
    source, reports_success = _find_source(trials)
    if not reports_success:
        yield Skipped(RULE.id, "no success is reported", applies=False)
        return
    if source is None:
        yield Skipped(RULE.id, "no goal next to the robot was a success")
        return
    axes = list(range(trials.goals.shape[1]))
    places: list[Numbers] = []
    shown: Sequence[float] = ()
    for number in range(MOST_EPISODES):
        inside = _measure(trials, source, number, np.zeros(trials.goals.shape[1]))
        if inside is None or not inside.succeeds:
            continue
        places.append(inside.place)
        rising = {axis: _measure_sides(trials, source, number, axis, inside) for axis in axes}
        axes = [axis for axis in axes if rising[axis]]
        if not axes:
            return
        shown = rising[axes[0]]
        if len(places) == EPISODES:
            break
    else:
        yield Skipped(RULE.id, "no goal next to the robot was a success in several episodes")
        return
    moved = np.ptp(np.array(places), axis=0) > FEWEST_MOVED * trials.range
    axes = [axis for axis in axes if moved[axis]]
    if axes:
        yield _describe(trials, axes, shown)


def _describe(trials: GoalTrials, axes: Sequence[int], shown: Sequence[float]) -> RuleFinding:
    name = trials.drawn.name
    parts = list_names([f"{name}[{axis}]" for axis in axes]) if trials.goals.shape[1] > 1 else name
    near, *_, far = shown
    lengths = " and ".join(f"{radius * trials.range[axes[0]]:.3g}" for radius in (RADII[0], RADII[-1]))
    message = f"the reward rises with the distance to the goal ({parts}): {near:.4g} and {far:.4g} at {lengths}"
    evidence = {"element": name, "value": far, "expected": f"below {near:.6g}"}
    return RuleFinding(RULE, message, evidence)


def _find_source(trials: GoalTrials) -> tuple[Source | None, bool]:
    """Return the part of the observation with the place that a goal has to have for a success; and whether success is
    reported at all."""
    episode, reports_success = _begin(trials, 0), False
    sources = find_sources(trials.drawn.copies, episode.observed[None], episode.goal[None])
    for source in sources[:MOST_SOURCES]:
        if episode.has_ended:
            episode = _begin(trials, 0)
        for step in episode.play([episode.read(source)]):
            reports_success |= step.succeeds is not None
            if step.succeeds:
                return source, True
    return None, reports_success


def _begin(trials: GoalTrials, number: int) -> GoalEpisode:
    return GoalEpisode(trials, FIRST_SEED + number, "repeated", FIRST_STEPS)


def _measure(trials: GoalTrials, source: Source, number: int, offset: Numbers) -> _Outcome | None:
    """Return what a goal gives that stays as far from the robot, which moves as in the last step; None if the episode
    ended before, or had a success already."""
    episode = GoalEpisode(trials, FIRST_SEED + number, "repeated", FIRST_STEPS - 1)
    before = episode.read(source)
    episode.play([None])
    outcome = None
    if episode.has_succeeded:
        return None
    for _ in range(LATER_STEPS):
        if episode.has_ended:
            break
        place = episode.read(source)
        step = episode.step(2 * place - before + offset)
        before = place
        outcome = _Outcome(step.reward, bool(step.succeeds), episode.has_ended, place)
    return outcome


def _measure_sides(trials: GoalTrials, source: Source, number: int, axis: int, inside: _Outcome) -> Sequence[float]:
    """Return the rewards with the goal at larger and larger distances to one side of the robot, if they rise, and so do
    those to the other side; or if all are larger than that of a success. Otherwise nothing."""
    shown: list[float] = []
    for sign in (1.0, -1.0):
        outside = []
        for radius in RADII:
            offset = np.zeros(trials.goals.shape[1])
            offset[axis] = sign * radius * trials.range[axis]
            outcome = _measure(trials, source, number, offset)
            if outcome is None or outcome.succeeds or outcome.has_ended:
                return ()
            outside.append(outcome.reward)
            if not _rises(outside) and not _exceeds(outside, inside):
                return ()
        shown = outside
    return shown


def _rises(rewards: Sequence[float]) -> bool:
    least = LEAST * max(1.0, *map(abs, rewards))
    return all(far > near + least for near, far in itertools.pairwise(rewards))


def _exceeds(rewards: Sequence[float], inside: _Outcome) -> bool:
    """Say whether failures never pay less with the distance, and more than a success that does not end the episode."""
    least = LEAST * max(1.0, *map(abs, rewards))
    falls = any(far < near - least for near, far in itertools.pairwise(rewards))
    return not inside.has_ended and not falls and rewards[0] > inside.reward + least
