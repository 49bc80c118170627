"""RL625: goals too far for an episode."""

import itertools
from collections.abc import Iterator

import numpy as np

from rlctl.checking.drawn_goals import TURNED, Numbers, Source
from rlctl.checking.experiments.goals import judges_goals
from rlctl.checking.goal_episodes import GoalEpisode, GoalTrials, measure_distances
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL625",
    "goals too far for an episode",
    Severity.WARNING,
    meaning="""
        The check played whole episodes, each with one action that was held, and none brought the robot further
        than a quarter of the way that half of the goals are away. Episodes then end before the goal can be
        reached, whatever a policy does. Most often the action is scaled down, or the time is too short.
    """,
    fix="Use what the motors can do, give the episode more time, or draw goals that are nearer.",
)

EPISODES = 8
LENGTHS = 25, 100, 400  # steps that are played, until it moved far enough; longer episodes are not judged
FAR = 4.0  # times the range of the goals
SLOW = 0.25  # part of the usual distance
MOVED = 1e-6  # part of the usual distance: what the action changes at least


@judges_goals(RULE, place=1)  # it plays whole episodes: the other rules come before
def _compare_ways(trials: GoalTrials) -> Iterator[ChildMessage]:
    """Play episodes with held actions, and compare how far they lead with how far the goals are."""
    source = trials.at_goal.source
    if source is None or not trials.drawn.place.is_place:
        yield Skipped(RULE.id, "it is not known what has to be at the goal", applies=False)
        return
    usual = float(np.median(measure_distances(trials, source)))
    farthest, steps = 0.0, 0
    for number, seed in enumerate(range(FIRST_SEED, FIRST_SEED + EPISODES)):
        if trials.instance.context.budget.seconds_left < _estimate_seconds(trials, source):
            yield Skipped(RULE.id, f"time is left for {number} of {EPISODES} episodes")
            return
        held = _measure_way(trials, source, seed, "repeated", SLOW * usual)
        if held is None:
            return
        nothing = _measure_way(trials, source, seed, "zero", SLOW * usual)
        if nothing is None:
            return
        if abs(held[0] - nothing[0]) < MOVED * usual:
            return  # the action does not move it, as an object that is not touched
        farthest, steps = max(farthest, held[0]), max(steps, held[1])
    name = trials.drawn.name
    how = f"with {EPISODES} actions, each held for a whole episode ({steps} steps)"
    message = f"{name} is {usual:.3g} away at the start (median); {how}, the robot gets {farthest:.3g} far at most"
    yield RuleFinding(RULE, message, {"element": name, "seed": FIRST_SEED, "value": farthest, "expected": usual})


def _estimate_seconds(trials: GoalTrials, source: Source) -> float:
    """Return how long the two episodes of a seed may take [s]."""
    longest = trials.instance.max_steps or trials.instance.context.longest_episode or LENGTHS[-1]
    steps = sum(min(length, longest) for length in LENGTHS)
    plays = trials.drawn.place.size + 1 if source[1] == TURNED else 1
    return 2 * plays * steps * (trials.instance.progress.mean_s("step") or 0.0)


def _measure_way(
    trials: GoalTrials, source: Source, seed: int, actions: str, enough: float
) -> tuple[float, int] | None:
    """Return how far an episode leads from its first step at most, and its steps; None if that is enough, if it
    succeeds, or has no end."""
    for most_steps in LENGTHS:
        places, has_ended = _trace(trials, source, seed, actions, most_steps)
        if len(places) == 0:
            return None
        farthest = float(np.linalg.norm(places - places[0], axis=1).max())
        if not farthest < enough:
            return None
        if has_ended:
            return farthest, len(places)
    return None


def _trace(trials: GoalTrials, source: Source, seed: int, actions: str, most_steps: int) -> tuple[Numbers, bool]:
    """Return where the robot is after each step of an episode, shape (steps, size), and whether the episode ended; no
    place if it succeeds."""
    if source[1] == TURNED:
        return _trace_turned(trials, source, seed, actions, most_steps)
    episode = GoalEpisode(trials, seed, actions)
    places = [episode.read(source) for _ in episode.follow(itertools.repeat(None, most_steps))]
    if episode.has_succeeded:
        places = []
    return np.array(places), episode.has_ended


def _trace_turned(trials: GoalTrials, source: Source, seed: int, actions: str, most_steps: int) -> tuple[Numbers, bool]:
    """Play the episode with the goal at several places, far away, and find the robot by its distances to them: from
    |a - p|^2 - |b - p|^2 = |a|^2 - |b|^2 - 2 p (a - b)."""
    size = trials.goals.shape[1]
    anchors = trials.goals.mean(axis=0) + FAR * trials.range.max() * np.vstack([np.eye(size), -np.ones(size)])
    squares = []
    for anchor in anchors:
        episode = GoalEpisode(trials, seed, actions)
        steps = episode.follow(itertools.repeat(anchor, most_steps))
        distances = [episode.measure_distance(source) for _ in steps]
        if episode.has_succeeded:
            return np.zeros((0, size)), True
        squares.append(np.square(distances))
    shortest = min(map(len, squares))
    differences = np.stack([square[:shortest] - squares[-1][:shortest] for square in squares[:-1]], axis=1)
    constants = np.square(anchors[:-1]).sum(axis=1) - np.square(anchors[-1]).sum()
    places = np.linalg.solve(2 * (anchors[:-1] - anchors[-1]), (constants - differences).T).T
    return places, episode.has_ended
