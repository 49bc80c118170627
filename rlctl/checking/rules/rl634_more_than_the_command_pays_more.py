"""RL634: more than the command pays more."""

import ast
from collections.abc import Iterator

import numpy as np

from rlctl.checking.command_sweeps import CommandSweep
from rlctl.checking.experiments.commands import CommandTrials, judges_commands
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.paid_errors import ErrorReader
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL634",
    "more than the command pays more",
    Severity.WARNING,
    meaning="""
        No value of the command is the best one for a motion: the check played the same step with many values of the
        command, and the reward rises without end as the command falls, or rises, or as it moves away from one value to
        both sides. So the policy is paid for moving as far beyond the command, or away from it, as it can. Most often
        the difference has no absolute value and no square, or the sign of the error's term is wrong. The source is
        read, too: a difference to a command or a goal that counts with its sign, the exponential of an error without a
        minus, or an even power of a cosine that is negative at times.
    """,
    fix="""
        Pay less for an error of either sign: np.exp(-(command - velocity)**2 / width), or -abs(command - velocity).
        If more than the command is welcome, cap it: min(velocity, command).
    """,
)

SAME_SLOPE = 1e-3  # relative difference of the slopes of lines
MOVES = 1e-6  # part of the range of the command by which the worst value has to vary


@judges_commands(RULE)
def _find_endless(trials: CommandTrials) -> Iterator[ChildMessage]:
    for place in trials.paid:
        sweep = trials.sweep(place)
        how = "" if sweep is None else _describe(sweep)
        if sweep is not None and how:
            name, low, high = trials.name(place), float(sweep.drawn.min()), float(sweep.drawn.max())
            message = (
                f"{how}, with {name} from {sweep.moments[0].values[0]:.3g} to {sweep.moments[0].values[-1]:.3g} in"
            )
            message += f" {len(sweep.moments)} of {len(sweep.moments)} steps (resets draw {low:.3g} to {high:.3g})"
            yield RuleFinding(RULE, message, {"element": name, "seed": FIRST_SEED})


def _describe(sweep: CommandSweep) -> str:
    """Say how the reward rises without end; empty where it does not."""
    moments = sweep.moments
    worst = np.array([moment.worst for moment in moments])
    if np.isfinite(worst).all() and np.ptp(worst) > MOVES * np.ptp(sweep.drawn):
        return "the reward is lowest where the motion is as commanded, and rises as the command moves away from it"
    slopes = np.array([moment.slope for moment in moments])
    lines = slopes[np.isfinite(slopes)]
    if lines.size and np.ptp(lines) > SAME_SLOPE * np.abs(lines).max():
        return ""  # a product of the command and a velocity
    if all(moment.grows_downwards for moment in moments):
        return "the reward rises without end as the command falls: more than the command pays more"
    if all(moment.grows_upwards for moment in moments):
        return "the reward rises without end as the command rises: less than the command pays more"
    return ""


@judges_expressions(RULE, decides=False)
def _find_signed_errors(notes: NotedEpisodes) -> Iterator[ChildMessage]:
    """Yield the first difference that the source pays with its sign, and the first even power of a cosine."""
    reader = notes.share(ErrorReader)
    for error in reader.find_errors():
        text, name = ast.unparse(error.place.node), error.summand.name
        values = notes.reward.numbers.list_values(error.place.node)
        how = f"{error.outer}(...)" if error.outer else "the plain difference"
        message = f"reward term {name!r} rises with {text} and does not end where this is 0: it is {how}, without a"
        message += " square or an absolute value"
        if values.size:
            message += f" ({text} was {values.min():.3g} to {values.max():.3g})"
        yield RuleFinding(RULE, message, {"element": name}, where=notes.reward.locate(error.place), same=("RL622",))
        return
    for summand, place in reader.find_growing():
        values, text = notes.reward.numbers.list_values(place.node), ast.unparse(place.node)
        message = f"reward term {summand.name!r} pays {text}, which grows with the size of an error and was up to"
        message += f" {values.max():.3g}: a minus is missing"
        yield RuleFinding(RULE, message, {"element": summand.name}, where=notes.reward.locate(place))
        return
    for summand, base in reader.find_powers():
        values, text = notes.reward.numbers.list_values(base.node), ast.unparse(base.node)
        message = f"reward term {summand.name!r} is an even power of {text}, which was {values.min():.3g} to"
        message += f" {values.max():.3g}: -1 pays as much as 1, and is no success"
        yield RuleFinding(RULE, message, {"element": summand.name}, where=notes.reward.locate(base))
        return
