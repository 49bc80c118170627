"""RL632: command that nothing pays."""

from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.experiments.goals import (
    DrawnGoal,
    DrawnPlace,
    GoalEpisode,
    GoalTrials,
    find_copies,
    find_drawn,
)
from rlctl.checking.instance import Context
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity, list_names
from rlctl.checking.term_names import split_name
from rlctl.checking.transitions import name_floats
from rlctl.checking.values import Attribute

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

COMMAND_WORDS = {"cmd", "cmds", "command", "commanded", "commands", "setpoint", "setpoints", "wanted"}
WISH_WORDS = {"desired", "ref", "reference", "target", "targets"}
MOTION_WORDS = {"height", "rate", "rates", "speed", "speeds", "turn", "vel", "velocities", "velocity", "yaw"}
"""What a wish is about that is paid in every step, and not only near a goal."""
MOST_NUMBERS = 8  # of a command
FIRST_STEPS, LATER_STEPS = 8, 3  # with the command that reset drew, and with another one
SEEDS = 4
SHIFTS = (-0.45, 0.2, 0.45)  # of a number of the command


@experiment("commands", PROBE, 111, RULE, share=0.3)
def change_commands(context: Context) -> Iterator[ChildMessage]:
    """Change each number of each command alone."""
    instance = context.instance
    if not instance.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    names = name_floats(instance.leaves)
    paid: list[str] = []
    unpaid: list[str] = []
    found = find_drawn(instance, _list_numbers)
    for name, places in found.stays.items():
        for place in places:
            copies = find_copies(instance, place)
            shown = [names[element] for element, _ in copies]
            if not copies or not any(_is_command(one) for one in (name, *shown)):
                continue
            drawn = DrawnGoal(place, copies, (), {}, {})
            changes = _change_rewards(GoalTrials(instance, drawn))
            if changes is not None:
                number = f"{name}[{place.elements[0]}]" if found.sizes[name] > 1 else name
                (paid if changes else unpaid).append(number)
            if context.budget.is_over():
                raise NotJudged("time ran out before all commands were changed")
    if not paid and not unpaid:
        raise NotApplicable("no command that reset draws is observed")
    if paid and unpaid:
        message = f"reset draws {list_names(unpaid)} and the observation shows it, but no reward depends on it: with"
        message += f" other values the rewards of the same steps are the same, and they differ with {list_names(paid)}"
        yield RuleFinding(RULE, message, {"element": unpaid[0], "seed": FIRST_SEED})


def _is_command(name: str) -> bool:
    words = set(split_name(name))
    return bool(words & COMMAND_WORDS or (words & WISH_WORDS and words & MOTION_WORDS))


def _list_numbers(one: Attribute, two: Attribute) -> list[DrawnPlace]:
    """Return each number that two resets drew differently."""
    size = one.numbers.size
    if np.asarray(one.value).dtype.kind != "f" or size != two.numbers.size or size > MOST_NUMBERS:
        return []
    return [DrawnPlace(one.name, (number,)) for number in np.flatnonzero(one.numbers != two.numbers).tolist()]


def _change_rewards(trials: GoalTrials) -> bool | None:
    """Say whether a number of the command changes any reward; None where no episode lasts."""
    compared = 0
    for seed in range(FIRST_SEED, FIRST_SEED + SEEDS):
        plain = _play(trials, seed, 0.0)
        for shift in SHIFTS:
            changed = _play(trials, seed, shift)
            compared += min(len(plain), len(changed))
            if changed != plain:
                return True
    return False if compared >= SEEDS * len(SHIFTS) else None


def _play(trials: GoalTrials, seed: int, shift: float) -> Sequence[float]:
    """Return the rewards of some steps with a shifted command; the robot has moved before."""
    episode = GoalEpisode(trials, seed, "repeated", FIRST_STEPS)
    if episode.has_ended:
        return []
    goal = episode.goal + shift
    return [step.reward for step in episode.play([goal] * LATER_STEPS)]
