"""RL624: success only next to the goal."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.drawn_goals import Numbers, Source
from rlctl.checking.experiments.goals import judges_goals
from rlctl.checking.goal_episodes import GoalTrials, measure_distances
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL624",
    "success only next to the goal",
    Severity.WARNING,
    meaning="""
        The check put the goal where the robot is, which is a success, and 0.5 % of a usual distance to the goal
        away from there, which is none. Hardly any policy comes so near. Most often a tolerance in metres is
        compared with a distance in centimetres or millimetres, or the other way round.
    """,
    fix="Compare a distance and a tolerance that have the same unit.",
)

NEAR = 0.005  # part of the usual distance
EPISODES = 3


@judges_goals(RULE)
def _find_narrow_success(trials: GoalTrials) -> Iterator[ChildMessage]:
    """Put the goal where the robot is after a few steps, and beside it."""
    at_goal = trials.at_goal
    if not at_goal.reports_success:
        yield Skipped(RULE.id, "no success is reported", applies=False)
        return
    if at_goal.source is None:
        yield Skipped(RULE.id, "no goal at the place of the robot was a success")
        return
    usual = float(np.median(measure_distances(trials, at_goal.source)))
    seeds = range(FIRST_SEED, FIRST_SEED + EPISODES)
    if not all(_is_narrow(trials, at_goal.source, seed, NEAR * usual) for seed in seeds):
        return
    name, away = trials.drawn.name, f"{NEAR * usual:.3g}"
    message = f"is_success is true with {name} where the robot is, and false with {name} {away} away from it"
    message += f"; {name} is {usual:.3g} away at the start (median)"
    yield RuleFinding(RULE, message, {"element": name, "seed": FIRST_SEED, "value": NEAR * usual, "expected": usual})


def _is_narrow(trials: GoalTrials, source: Source, seed: int, away: float) -> bool:
    """Say whether a goal is a success where the robot is, and none at a distance to each side of it."""
    place = trials.find_place(source, seed)
    if place is None or not trials.succeeds(seed, place):
        return False  # also where a goal has to be held, while the robot moves
    return all(trials.succeeds(seed, goal) is False for goal in _surround(place, away))


def _surround(place: Numbers, away: float) -> Iterator[Numbers]:
    for axis in np.eye(place.size):
        yield place + away * axis
        yield place - away * axis
