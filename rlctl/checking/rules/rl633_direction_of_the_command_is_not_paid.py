"""RL633: direction of the command is not paid."""

import ast
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.command_sizes import SizeReader
from rlctl.checking.drawn_goals import DrawnPlace, Numbers
from rlctl.checking.experiments.commands import LATER_STEPS, CommandTrials, judges_commands
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.paid_commands import CommandReader
from rlctl.checking.paid_lengths import LengthReader
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL633",
    "direction of the command is not paid",
    Severity.WARNING,
    meaning="""
        The reward follows how large a command is, and not in which direction it points: the check played the same
        steps with the command turned back, and to the sides, and each reward was the same, while it changes with the
        length of the command. So driving in any direction at the commanded speed is paid in full. Most often two
        lengths are compared, |v| with |command|, which is also read in the source; or a command that has both signs
        with a number that is never negative, so that half of the commands cannot be met; or what is called the speed
        forwards, or along a direction, is the length of the velocity.
    """,
    fix="Take the length of the difference: np.linalg.norm(velocity - command), and not the difference of the lengths.",
)

ALONG = "Multiply the velocity with the direction: velocity @ direction, or cos(heading) * vx + sin(heading) * vy."
LENGTHS = (0.0, 0.1, 0.25, 0.5, 0.8, 1.2)  # parts of the longest command that was drawn
DRAWN = 9  # resets, whose commands are compared
SAME = 1e-9  # of the rewards, or of 1
FEWEST_RISES = 3  # different rewards: a command that is only compared with a limit has two
SEEDS = 3
MOVING_STEPS = (20, 8)  # before the command is changed; the fewer where the episode ends before
MOST_NUMBERS = 3  # of a direction


@judges_commands(RULE)
def _find_lengths(trials: CommandTrials) -> Iterator[ChildMessage]:
    """Yield the first pair, or number, of a command whose direction does not matter."""
    for place in _list_blocks(trials.paid):
        drawn = _draw(trials, place)
        if not (drawn.min(axis=0) < 0).all() or not (drawn.max(axis=0) > 0).all():
            continue  # a speed has no direction
        longest = float(np.linalg.norm(drawn, axis=1).max())
        if all(_is_length_paid(trials, place, seed, longest) for seed in range(FIRST_SEED, FIRST_SEED + SEEDS)):
            names = " and ".join(trials.name(DrawnPlace(place.name, (element,))) for element in place.elements)
            how = "turned" if place.size > 1 else "with the other sign"
            message = f"the reward follows the length of the command ({names}), and not its direction: with the command"
            message += f" {how} the same steps pay the same in {SEEDS} episodes, and with another length they do not"
            yield RuleFinding(RULE, message, {"element": names.partition(" and ")[0], "seed": FIRST_SEED})
            return


def _list_blocks(places: Sequence[DrawnPlace]) -> Iterator[DrawnPlace]:
    """Yield what may be a direction: consecutive numbers of an attribute, the most first, and then single numbers."""
    for size in range(MOST_NUMBERS, 0, -1):
        for first in range(len(places) - size + 1):
            block = places[first : first + size]
            elements = tuple(element for place in block for element in place.elements)
            is_consecutive = elements == tuple(range(elements[0], elements[0] + size))
            if is_consecutive and len({place.name for place in block}) == 1:
                yield DrawnPlace(block[0].name, elements)


def _draw(trials: CommandTrials, place: DrawnPlace) -> Numbers:
    """Return what some resets draw. Shape (DRAWN, size)."""
    drawn = []
    for seed in range(FIRST_SEED, FIRST_SEED + DRAWN):
        trials.instance.reset(seed)
        drawn.append(place.read(trials.instance.env))
    return np.array(drawn)


def _is_length_paid(trials: CommandTrials, place: DrawnPlace, seed: int, longest: float) -> bool:
    """Say whether commands of a length pay the same in all directions, some lengths more than none, and most of them
    differently: where the robot rests, no direction is better than another, and none at all is best."""
    directions = _list_directions(place.size)
    paid: list[float] = []
    for part in (LENGTHS[-1], *LENGTHS[:-1]):
        rewards = [_pay(trials, place, seed, part * longest * direction) for direction in directions]
        if not all(np.isfinite(rewards)) or np.ptp(rewards) > SAME * max(1.0, abs(rewards[0])):
            return False
        paid.append(rewards[0])
    least = SAME * max(1.0, *map(abs, paid))
    is_best_in_motion = max(paid) > paid[1] + least  # the second one is that without a command
    return is_best_in_motion and len(np.unique(np.round(np.array(paid) / (10 * least)))) > FEWEST_RISES


def _list_directions(size: int) -> list[Numbers]:
    axes = np.eye(size)
    between = np.ones((1, size)) / np.sqrt(size)
    return [*axes, *-axes, *(between if size > 1 else between[:0])]


def _pay(trials: CommandTrials, place: DrawnPlace, seed: int, command: Numbers) -> float:
    for first in MOVING_STEPS:
        rewards = trials.play(place, seed, lambda _: command, first)
        if len(rewards) == LATER_STEPS:
            return rewards[-1]
    return np.nan


@judges_expressions(RULE, decides=False)
def _find_compared_lengths(notes: NotedEpisodes) -> Iterator[ChildMessage]:
    """Yield the first difference of lengths in the source of the reward."""
    for summand, place in notes.share(CommandReader).find_lengths():
        message = f"reward term {summand.name!r} compares lengths only, and nothing compares the direction:"
        message += f" {ast.unparse(place.node)}"
        yield RuleFinding(RULE, message, {"element": summand.name}, where=notes.reward.locate(place))
        return
    for one in notes.share(SizeReader).find_one_sided():
        message = (
            f"reward term {one.summand.name!r} compares a command that has both signs with {ast.unparse(one.size)},"
        )
        message += f" which is never negative: {ast.unparse(one.place.node)}"
        yield RuleFinding(RULE, message, {"element": one.summand.name}, where=notes.reward.locate(one.place))
        return
    for one in notes.share(SizeReader).find_sizes_only():
        message = f"reward term {one.summand.name!r} compares two sizes, {ast.unparse(one.place.node)}: the opposite"
        message += " command pays the same"
        yield RuleFinding(RULE, message, {"element": one.summand.name}, where=notes.reward.locate(one.place))
        return
    for length in notes.share(LengthReader).find():
        message = f"reward term {length.summand.name!r} has {ast.unparse(length.place.node)}, called {length.called!r}:"
        message += " it is a length, so motion in any direction is paid as the one that is meant"
        yield RuleFinding(
            RULE, message, {"element": length.summand.name}, fix=ALONG, where=notes.reward.locate(length.place)
        )
        return
