"""RL637: progress is counted from the start; the experiment is that of RL114."""

from rlctl.checking.rule import Rule, Severity
from rlctl.checking.term_names import is_place, split_name

RULE = Rule(
    "RL637",
    "progress is counted from the start",
    Severity.WARNING,
    meaning="""
        The reward pays progress, the distance before minus the distance now, and the distance before is set in reset
        and never again: each step is paid for the whole way since the start, also those in which nothing moves. The
        check replaced an attribute that is named after the previous step: the same episode then had the same
        observations, and other rewards in most steps, not only in the first one.
    """,
    fix="Set the previous value in each step, after the reward is computed.",
)

PREVIOUS_WORDS = {"before", "former", "last", "old", "prev", "previous", "prior"}


def is_previous(name: str) -> bool:
    """Say whether an attribute is named after the previous step. The last goal is the end of a course."""
    return bool({*split_name(name)} & PREVIOUS_WORDS) and not is_place(name)
