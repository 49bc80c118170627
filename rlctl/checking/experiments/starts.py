"""The experiment `starts`: plays the first steps after many resets."""

from collections.abc import Iterator

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.instance import Context
from rlctl.checking.recording import Recording
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped

STARTS = 30
START_STEPS = 3  # More than one, to tell what belongs to the episode from chance in each step
FIRST = FIRST_SEED + 100  # The first of their seeds; none of the whole episodes has them


@experiment("starts", PROBE, 60, share=1.0)
def record_starts(context: Context) -> Iterator[ChildMessage]:
    """Reset with many seeds, and take the same few steps with the zero action after each."""
    for number in range(STARTS):
        if why := context.budget.why_spent():
            yield Skipped("starts", f"only {number} of {STARTS} starts were made: {why}")
            return
        episode = EpisodePlayer(context.instance, FIRST + number, "zero", number=number, max_steps=START_STEPS)
        yield from Recording("starts", episode).run()
