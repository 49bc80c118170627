"""Many starts of episodes: what differs from seed to seed, when nothing is done."""

from __future__ import annotations

from collections.abc import Iterator

from rlctl.check_env.context import Context
from rlctl.check_env.evidence import FIRST_SEED
from rlctl.check_env.legacy import skip
from rlctl.check_env.messages import Message
from rlctl.check_env.recording import Plan, Recording

ROLE = "starts"
STARTS = 30
START_STEPS = 3
"""More than one, to tell what belongs to the episode from chance in each step."""
FIRST = FIRST_SEED + 100
"""The first of its seeds; none of the whole episodes has them."""
MAX_FAILURES = 3


def starts(context: Context) -> Iterator[Message]:
    """Reset with many seeds, and take the same few steps with the zero action after each."""
    failures = 0
    for number in range(STARTS):
        if context.budget.seconds_left < 0 or context.budget.bytes_left < 0 or failures >= MAX_FAILURES:
            yield skip(ROLE, f"only {number} of {STARTS} starts could be made")
            return
        plan = Plan(ROLE, number, FIRST + number, "zero", max_steps=START_STEPS)
        recording = Recording(context.instance, plan, context.budget)
        yield from recording.run()
        failures += recording.failure is not None
