"""The experiment `starts`: plays the first steps after many resets."""

from collections.abc import Iterator

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.instance import Context
from rlctl.checking.recording import Recording
from rlctl.checking.records import FIRST_SEED, CheckedEpisode, ChildMessage, Skipped
from rlctl.environments.success import SUCCESS

STARTS = 30
START_STEPS = 3  # More than one, to tell what belongs to the episode from chance in each step
WHOLE, WHOLE_STEPS, ENOUGH = "whole starts", 200, 5
"""Starts that succeed at once and go on are played on: an episode succeeds if it does at its end, and `is_success` may
be about a mean of the episode so far."""
FIRST = FIRST_SEED + 100  # The first of their seeds; none of the whole episodes has them


@experiment("starts", PROBE, 60, share=1.0)
def record_starts(context: Context) -> Iterator[ChildMessage]:
    """Reset with many seeds, and take the same few steps with the zero action after each."""
    played_on = 0
    for number in range(STARTS):
        if why := context.budget.why_spent():
            yield Skipped("starts", f"only {number} of {STARTS} starts were made: {why}")
            return
        episode = EpisodePlayer(context.instance, FIRST + number, "zero", number=number, max_steps=START_STEPS)
        recording = Recording("starts", episode)
        yield from recording.run()
        if played_on < ENOUGH and succeeds_and_goes_on(recording.trajectory):
            played_on += 1
            again = EpisodePlayer(context.instance, FIRST + number, "zero", number=number, max_steps=WHOLE_STEPS)
            yield from Recording(WHOLE, again).run()


def succeeds_at_once(start: CheckedEpisode) -> bool:
    """Say whether `is_success` was true at the first step."""
    success = start.infos.get(SUCCESS)
    return success is not None and bool((success.values[success.steps <= 1] > 0).any())


def succeeds_and_goes_on(start: CheckedEpisode) -> bool:
    """Say whether `is_success` was true at the first step, which did not end the episode."""
    return succeeds_at_once(start) and not (start.terminated[:1] | start.truncated[:1]).any()
