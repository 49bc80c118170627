"""RL622: being far from the goal pays."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from rlctl.checking.experiments.goals import (
    MOST_SOURCES,
    GoalEpisode,
    GoalTrials,
    Numbers,
    Source,
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
        success, which goes on; or a goal that goes away pays more than one that comes nearer. The check played
        the same steps again, and put the goal, or the command, where is_success is true, and at several
        distances from there. So the policy learns to keep away from the goal. Most often a sign is wrong, or an
        error is paid instead of a function that falls with it.
    """,
    fix="""
        Make the reward largest where the task is done: subtract the distance or the error, pay
        exp(-error / scale), or pay progress as previous - distance.
    """,
)

FIRST_STEPS = 10  # with the action that the episode holds, so that the robot is somewhere else in each
LATER_STEPS = 2  # with the goal moved: the first may pay the way to it as progress
EPISODES, MOST_EPISODES = 3, 10  # that are needed, and that are tried
FEWEST_MOVED = 0.02  # part of the goals' range: how far apart the robot is in these episodes
RADII = (0.35, 0.7, 1.0)  # parts of the goals' range
WAY_RADIUS, WAY = 0.7, 0.2
"""Parts of the goals' range, at which a goal is that comes nearer or goes away in a step, and of this distance."""
MOST_TURN = 0.45  # part of a turn: an angle that is further away is nearer on the other side
LEAST = 1e-6  # differences of rewards that count, of their size


@dataclasses.dataclass(frozen=True)
class _Outcome:
    """What a goal gave that is as far from the robot as `offset`."""

    reward: float
    succeeds: bool
    has_ended: bool  # and how: by this step or one before
    place: Numbers  # of the robot


_MeasureAxis = Callable[[GoalTrials, Source, int, int, _Outcome], Sequence[float]]
"""Returns rewards that show something wrong along an axis in an episode, or nothing."""
_Describe = Callable[[GoalTrials, Sequence[int], Sequence[float]], RuleFinding]
"""Describes what is wrong along some axes, by these rewards."""


@judges_goals(RULE)
def _compare_goals(trials: GoalTrials) -> Iterator[ChildMessage]:
    """Put the goal where the robot is, and to either side."""
    source, reports_success = _find_source(trials)
    if not reports_success:
        yield Skipped(RULE.id, "no success is reported", applies=False)
        return
    is_held = source is None  # whether a success takes longer than the steps that are compared
    source = trials.at_goal.source if source is None else source
    if source is None:
        yield Skipped(RULE.id, "no goal next to the robot was a success")
        return
    insides = _find_insides(trials, source, is_held)
    if len(insides) < EPISODES:
        yield Skipped(RULE.id, _explain_few(len(insides)))
        return
    moved = np.ptp(np.array([inside.place for inside in insides.values()]), axis=0) > FEWEST_MOVED * trials.range
    looks: list[tuple[_MeasureAxis, _Describe]] = [
        (_measure_sides, _describe_distance),
        (_measure_ways, _describe_way),
    ]
    for measure, describe in looks:
        axes, shown = _find_axes(trials, source, insides, measure)
        axes = [axis for axis in axes if moved[axis]]
        if axes:
            yield describe(trials, axes, shown)
            return


def _explain_few(count: int) -> str:
    """Return why `count` episodes with a success are too few."""
    return (
        f"with the goal put where the robot is, {count} of {MOST_EPISODES} episodes had a success; "
        f"the comparison needs {EPISODES}"
    )


def _find_insides(trials: GoalTrials, source: Source, is_held: bool) -> dict[int, _Outcome]:
    """Return what a goal gives that is where the robot is, by episode; of those in which it is a success, at once or
    later."""
    insides: dict[int, _Outcome] = {}
    for number in range(MOST_EPISODES):
        inside = _measure(trials, source, number, np.zeros((LATER_STEPS, trials.goals.shape[1])))
        if inside is not None and (inside.succeeds or is_held):
            insides[number] = inside
        if len(insides) == EPISODES:
            break
    return insides


def _find_axes(
    trials: GoalTrials, source: Source, insides: Mapping[int, _Outcome], measure: _MeasureAxis
) -> tuple[list[int], Sequence[float]]:
    """Return the axes along which something wrong is measured in all episodes, and rewards that show it."""
    axes = list(range(trials.goals.shape[1]))
    shown: Sequence[float] = ()
    for number, inside in insides.items():
        wrong = {axis: measure(trials, source, number, axis, inside) for axis in axes}
        axes = [axis for axis in axes if wrong[axis]]
        if not axes:
            return [], ()
        shown = wrong[axes[0]]
    return axes, shown


def _describe_distance(trials: GoalTrials, axes: Sequence[int], shown: Sequence[float]) -> RuleFinding:
    near, *_, far = shown
    lengths = " and ".join(f"{radius * _find_room(trials, axes[0]):.3g}" for radius in (RADII[0], RADII[-1]))
    rises = f"the reward rises with the distance to the goal ({_name_axes(trials, axes)})"
    if far <= near:
        rises = f"the reward is larger at any distance to the goal ({_name_axes(trials, axes)}) than at the goal"
    message = f"{rises}: {near:.4g} and {far:.4g} at {lengths}"
    evidence = {"element": trials.drawn.name, "value": far, "expected": f"below {near:.6g}"}
    return RuleFinding(RULE, message, evidence)


def _describe_way(trials: GoalTrials, axes: Sequence[int], shown: Sequence[float]) -> RuleFinding:
    near, far = shown
    way = f"{WAY * WAY_RADIUS * _find_room(trials, axes[0]):.3g}"
    comes = f"the reward is {near:.4g} where the goal ({_name_axes(trials, axes)}) comes {way} nearer in a step"
    message = f"{comes}, and {far:.4g} where it goes as far away"
    evidence = {"element": trials.drawn.name, "value": far, "expected": f"below {near:.6g}"}
    return RuleFinding(RULE, message, evidence)


def _name_axes(trials: GoalTrials, axes: Sequence[int]) -> str:
    return list_names([trials.drawn.name_axis(axis) for axis in axes])


def _find_source(trials: GoalTrials) -> tuple[Source | None, bool]:
    """Return the part of the observation with the place that a goal has to have for a success; and whether success is
    reported at all."""
    episode, reports_success = _begin(trials, 0), False
    for source in trials.list_sources(episode)[:MOST_SOURCES]:
        if episode.has_ended:
            episode = _begin(trials, 0)
        for step in episode.play([episode.read(source)]):
            reports_success |= step.succeeds is not None
            if step.succeeds:
                return source, True
    return None, reports_success


def _begin(trials: GoalTrials, number: int) -> GoalEpisode:
    return GoalEpisode(trials, FIRST_SEED + number, "repeated", FIRST_STEPS)


def _measure(trials: GoalTrials, source: Source, number: int, offsets: Numbers) -> _Outcome | None:
    """Return what a goal gives that is so far from the robot in the later steps, which moves as in the last one; None
    if the episode ended before, or had a success already. Shape of the offsets: (LATER_STEPS, size)."""
    episode = GoalEpisode(trials, FIRST_SEED + number, "repeated", FIRST_STEPS - 1)
    before = episode.read(source)
    episode.play([None])
    outcome = None
    if episode.has_succeeded:
        return None
    for offset in offsets:
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
            offsets = np.zeros((LATER_STEPS, trials.goals.shape[1]))
            offsets[:, axis] = sign * radius * _find_room(trials, axis)
            outcome = _measure(trials, source, number, offsets)
            if outcome is None or outcome.succeeds or outcome.has_ended:
                return ()
            outside.append(outcome.reward)
            if not _rises(outside) and not _exceeds(outside, inside):
                return ()
        shown = outside
    return shown


def _measure_ways(trials: GoalTrials, source: Source, number: int, axis: int, _: _Outcome) -> Sequence[float]:
    """Return the rewards with a goal to one side of the robot that comes nearer in the last step, and with one that
    goes as far away, if the second is larger, and so it is to the other side. Otherwise nothing."""
    shown: list[float] = []
    for sign in (1.0, -1.0):
        rewards = []
        for change in (-WAY, WAY):
            offsets = np.zeros((LATER_STEPS, trials.goals.shape[1]))
            offsets[:, axis] = sign * WAY_RADIUS * _find_room(trials, axis)
            offsets[-1] *= 1 + change
            outcome = _measure(trials, source, number, offsets)
            if outcome is None or outcome.succeeds or outcome.has_ended:
                return ()
            rewards.append(outcome.reward)
        if not _rises(rewards):
            return ()
        shown = rewards
    return shown


def _find_room(trials: GoalTrials, axis: int) -> float:
    """Return how far from the robot a goal may be put along an axis."""
    return float(min(trials.range[axis], MOST_TURN * trials.turns[axis]))


def _rises(rewards: Sequence[float]) -> bool:
    least = LEAST * max(1.0, *map(abs, rewards))
    return all(far > near + least for near, far in itertools.pairwise(rewards))


def _exceeds(rewards: Sequence[float], inside: _Outcome) -> bool:
    """Say whether failures pay more than a success that does not end the episode."""
    least = LEAST * max(1.0, *map(abs, rewards))
    return not inside.has_ended and min(rewards) > inside.reward + least
