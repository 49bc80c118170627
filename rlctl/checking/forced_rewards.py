"""What steps pay where expressions of the source are worth something else, and all else is as it was."""

import math
from collections.abc import Mapping

import numpy as np

from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.expressions import NotedCall

STEP = 6  # that is looked at: robots have settled
FEWEST_STEPS = 3


class ForcedRewards:
    """Plays the first steps of noted episodes again, and reads the last reward."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes = notes

    def find_last(self, number: int, later: int = 0) -> int | None:
        """Return which step of an episode is looked at; None where it is too short."""
        if number >= len(self.notes.episodes):
            return None
        last = min(STEP + later, len(self.notes.episodes[number]) - 2)
        return last if last >= FEWEST_STEPS else None

    def pay(
        self,
        number: int,
        last: int,
        forced: Mapping[int, float | bool],
        lasting: int = 1,
        at_last: Mapping[int, float | bool] | None = None,
    ) -> tuple[float, NotedCall | None]:
        """Return the reward of a step of an episode, and what was noted in it, where expressions are worth what is
        given in so many steps up to it; and others in it alone. NaN where the episode ends before."""
        steps = {step: self._fill(number, forced) for step in range(max(1, last - lasting + 1), last + 1)}
        steps[last] |= self._fill(number, at_last or {})
        played = self.notes.play(number, last, steps)
        return (played[last][1].reward_number, played[last][0]) if len(played) > last else (math.nan, None)

    def _fill(self, number: int, forced: Mapping[int, float | bool]) -> dict[int, object]:
        """Return the values in the shapes that the expressions have."""
        filled: dict[int, object] = {}
        for one, value in forced.items():
            known = [found for call in self.notes.episodes[number] for found in call.values.get(one, ())]
            shape = np.shape(known[0]) if known and isinstance(known[0], np.ndarray) else ()
            filled[one] = np.full(shape, value) if shape else value
        return filled
