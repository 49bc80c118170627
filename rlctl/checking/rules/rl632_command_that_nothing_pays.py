"""RL632: command that nothing pays."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.experiments.goals import (
    DrawnPlace,
    GoalEpisode,
    GoalTrials,
    Numbers,
    find_copies,
    judges_goals,
)
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.term_names import split_name

RULE = Rule(
    "RL632",
    "command that nothing pays",
    Severity.WARNING,
    meaning="""
        Each reset draws a command, the observation shows it, and one of its numbers decides nothing of the reward: the
        check played the same steps with other values of it, and each reward was the same to the bit, while other
        numbers of the command change the reward. The policy learns to ignore it. Most often the reward compares with
        another element of the command than it should.
    """,
    fix="""
        Compare each velocity with its own element of the command: if the command is (forward speed, turn rate), the
        turn rate with command[1].
    """,
)

COMMAND_WORDS = {"cmd", "cmds", "command", "commanded", "commands"}
FIRST_STEPS, LATER_STEPS = 8, 3  # with the command that reset drew, and with another one
SEEDS = 4
SHIFTS = (-0.45, 0.2, 0.45)  # parts of the commands' range
LEAST_SHIFT = 0.05  # where all commands are the same along an axis


@judges_goals(RULE, place=1)
def _find_unpaid_commands(trials: GoalTrials) -> Iterator[ChildMessage]:
    """Change each number of each command alone."""
    paid: list[str] = []
    unpaid: list[str] = []
    for place in (trials.drawn.place, *trials.others):
        if not COMMAND_WORDS & set(split_name(place.name)):
            continue
        if trials.instance.context.budget.is_over():
            return
        of_place = dataclasses.replace(trials, drawn=dataclasses.replace(trials.drawn, place=place))
        if place != trials.drawn.place and not find_copies(trials.instance, place):
            continue
        for axis in range(place.size):
            changes = _change_rewards(of_place, place, axis)
            if changes is not None:
                (paid if changes else unpaid).append(of_place.drawn.name_axis(axis))
    if paid and unpaid:
        message = f"reset draws {list_names(unpaid)} and the observation shows it, but no reward depends on it: with"
        message += f" other values the rewards of the same steps are the same, and they differ with {list_names(paid)}"
        yield RuleFinding(RULE, message, {"element": unpaid[0], "seed": FIRST_SEED})


def _change_rewards(trials: GoalTrials, place: DrawnPlace, axis: int) -> bool | None:
    """Say whether a number of the command changes any reward; None where no episode lasts."""
    compared = 0
    for seed in range(FIRST_SEED, FIRST_SEED + SEEDS):
        plain = _play(trials, seed, np.zeros(place.size))
        for part in SHIFTS:
            shift = np.zeros(place.size)
            shift[axis] = part * max(_find_range(trials, place)[axis], LEAST_SHIFT)
            changed = _play(trials, seed, shift)
            compared += min(len(plain), len(changed))
            if list(changed) != list(plain):
                return True
    return False if compared >= SEEDS * len(SHIFTS) else None


def _find_range(trials: GoalTrials, place: DrawnPlace) -> Numbers:
    if trials.goals.shape[1] == place.size:
        return trials.range
    return np.ones(place.size)


def _play(trials: GoalTrials, seed: int, shift: Numbers) -> Sequence[float]:
    """Return the rewards of some steps with a shifted command; the robot has moved before."""
    episode = GoalEpisode(trials, seed, "repeated", FIRST_STEPS)
    if episode.has_ended:
        return []
    goal = episode.goal + shift
    return [step.reward for step in episode.play([goal] * LATER_STEPS)]
