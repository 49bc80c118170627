"""RL632: command that nothing pays."""

from collections.abc import Iterator

from rlctl.checking.experiments.commands import CommandTrials, judges_commands
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
        another element of the command than it should.
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
