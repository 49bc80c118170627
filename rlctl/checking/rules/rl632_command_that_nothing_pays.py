"""RL632: command that nothing pays."""

import ast
from collections.abc import Iterator

from rlctl.checking.command_sizes import SizeReader
from rlctl.checking.experiments.commands import CommandTrials, judges_commands
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.paid_commands import CommandReader
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names

RULE = Rule(
    "RL632",
    "command that nothing pays",
    Severity.WARNING,
    meaning="""
        Each reset draws a command, the observation shows it, and one of its numbers decides nothing of the reward: the
        check played the same steps with other values of it, and each reward was the same to the bit, while other
        numbers of the command change the reward. The policy learns to ignore it. Most often the reward compares with
        another element of the command than it should. The source is read, too: two terms compare the same number of
        the command, and no term another one; or a term of a command is nearly its maximum in all steps, whatever the
        motion is, since its tolerance is far too wide, or in another unit.
    """,
    fix="""
        Compare each velocity with its own element of the command: if the command is (forward speed, turn rate), the
        turn rate with command[1].
    """,
)


@judges_commands(RULE)
def _find_unpaid(trials: CommandTrials) -> Iterator[ChildMessage]:
    if trials.paid and trials.unpaid:
        paid, unpaid = ([trials.name(place) for place in places] for places in (trials.paid, trials.unpaid))
        message = f"reset draws {list_names(unpaid)} and the observation shows it, but no reward depends on it: with"
        message += f" other values the rewards of the same steps are the same, and they differ with {list_names(paid)}"
        yield RuleFinding(RULE, message, {"element": unpaid[0], "seed": FIRST_SEED})


@judges_expressions(RULE, decides=False)
def _find_unread(notes: NotedEpisodes) -> Iterator[ChildMessage]:
    """Yield the first number of a command that is compared with two things, while another is with none."""
    for same, unpaid in notes.share(CommandReader).find_unpaid():
        command, index = same[0].command, same[0].index
        names = list_names(list(dict.fromkeys(one.summand.name for one in same)))
        message = f"the reward compares {command}[{index}] in {names}, and {command}[{unpaid}] with nothing:"
        message += f" {ast.unparse(same[-1].place.node)}"
        evidence = {"element": f"{command}[{unpaid}]"}
        yield RuleFinding(RULE, message, evidence, where=notes.reward.locate(same[-1].place))
        return
    for one in notes.share(SizeReader).find_always_met():
        message = (
            f"reward term {one.summand.name!r} is at least {one.least:.4g} of 1 in all steps, whatever the command"
        )
        message += f" and the motion are: the tolerance of {ast.unparse(one.place.node)} is far above any difference"
        message += f" {ast.unparse(one.difference)}"
        yield RuleFinding(RULE, message, {"element": one.summand.name}, where=notes.reward.locate(one.place))
        return
