"""RL625: goals too far for an episode."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiments.goals import (
    TURNED,
    GoalEpisode,
    GoalTrials,
    Source,
    judges_goals,
    measure_distances,
)
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
LONGEST = 400  # steps; longer episodes are not judged
SLOW = 0.25  # part of the usual distance
MOVED = 1e-6  # part of the usual distance: what the action changes at least


@judges_goals(RULE)
def _compare_ways(trials: GoalTrials) -> Iterator[ChildMessage]:
    """Play episodes with held actions, and compare how far they lead with how far the goals are."""
    source = trials.at_goal.source
    if source is None:
        yield Skipped(RULE.id, "it is not known what has to be at the goal", applies=False)
        return
    if source[1] == TURNED:
        yield Skipped(RULE.id, "the goal is observed in the frame of a robot that turns", applies=False)
        return
    usual = float(np.median(measure_distances(trials, source)))
    farthest, steps = 0.0, 0
    for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
        held = _measure_way(trials, source, seed, "repeated", SLOW * usual)
        nothing = _measure_way(trials, source, seed, "zero", SLOW * usual)
        if held is None or nothing is None:
            return
        if abs(held[0] - nothing[0]) < MOVED * usual:
            return  # the action does not move it, as an object that is not touched
        farthest, steps = max(farthest, held[0]), max(steps, held[1])
    name = trials.drawn.name
    how = f"with {EPISODES} actions, each held for a whole episode ({steps} steps)"
    message = f"{name} is {usual:.3g} away at the start (median); {how}, the robot gets {farthest:.3g} far at most"
    yield RuleFinding(RULE, message, {"element": name, "seed": FIRST_SEED, "value": farthest, "expected": usual})


def _measure_way(
    trials: GoalTrials, source: Source, seed: int, actions: str, enough: float
) -> tuple[float, int] | None:
    """Return how far an episode leads from its start at most, and its steps; None if that is enough, if it succeeds,
    or has no end."""
    episode = GoalEpisode(trials, seed, actions)
    start, farthest = episode.read(source), 0.0
    for step in range(1, LONGEST + 1):
        episode.step()
        farthest = max(farthest, float(np.linalg.norm(episode.read(source) - start)))
        if not farthest < enough or episode.has_succeeded:
            return None
        if episode.has_ended:
            return farthest, step
    return None
