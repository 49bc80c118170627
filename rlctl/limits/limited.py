"""An actor within the limits of a safety filter, in simulation and in a server."""

import collections
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rlctl.environments.dict_spaces import map_parts, take_row
from rlctl.environments.info import EnvInfo
from rlctl.limits.limits import Limits
from rlctl.limits.safety_filter import SafetyFilter
from rlctl.policy.actor import Actor, Array, Exploration, Rows, as_stored

Measure = Callable[[int], Any]
"""Returns what is measured in a row."""


class Limited(Actor):
    """Passes the actions of another actor through a safety filter per row; reports the number of interventions."""

    def __init__(
        self,
        actor: Actor,
        info: EnvInfo,
        limits: Limits | None,
        count: int = 1,
        *,
        measure: Measure | None = None,
        holds_on_errors: bool = False,
    ) -> None:
        """Bound the actions of `actor`, whose observations and actions `info` describes.

        `measure` returns what the filter of a row observes in place of the actor's observation. With `holds_on_errors`
        an exception of the actor is kept in `error`, and the filter holds the robot.
        """
        self.actor = actor
        self._measure = measure
        self._holds_on_errors = holds_on_errors
        self.ages_s: Sequence[float] | None = None
        """How old the next observations are [s], one of each row that acts; None for 0."""
        self.requested: list[Array | None] = []
        """What the actor returned in the last step, before the limits; None where it could not act."""
        self.error: Exception | None = None  # of the actor in the last step
        self.acting_s = 0.0  # the time that it took in the last step [s]
        self.filters = [SafetyFilter(info, limits) for _ in range(count)]
        self._before = [collections.Counter[str]() for _ in range(count)]
        self._moved = np.zeros((count, 2))  # sums of the joints' measured and commanded motions in each episode

    @property
    def state(self) -> Array | None:
        """Recurrent states of the actor."""
        return self.actor.state

    def explore(self, exploration: Exploration) -> None:
        """Let the actor explore."""
        self.actor.explore(exploration)

    def prepare(self) -> None:
        """Begin a segment."""
        self.actor.prepare()

    def begin(self, rows: Rows) -> None:
        """Begin episodes, and end what the limits hold."""
        self.actor.begin(rows)
        for row in rows.index.tolist():
            safety = self.filters[row]
            safety.resume()
            safety.reset()
            self._before[row], self._moved[row] = safety.counts, 0.0

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the limited actions, to record and to step with; the actor acts where it may."""
        places = rows.index.tolist()
        is_sound = [self._observe(row, take_row(observations, k), k) for k, row in enumerate(places)]
        self.requested = self._request(observations, rows, np.flatnonzero(is_sound))
        pairs = zip(places, self.requested, strict=True)
        limited = np.stack([self.filters[row].limit(action) for row, action in pairs])
        return as_stored(limited), limited

    def _request(self, observations: Any, rows: Rows, chosen: Array) -> list[Array | None]:
        """Return the actor's actions, one for each row; None for those that are not `chosen`, or after an error."""
        requested: list[Array | None] = [None] * len(rows)
        self.error, self.acting_s = None, 0.0
        if not len(chosen):
            return requested
        seen = map_parts(lambda part: part[chosen], observations)
        begin = time.perf_counter()
        try:
            _, actions = self.actor.act(seen, rows.select(chosen))
        except Exception as error:
            if not self._holds_on_errors:
                raise
            self.error = error
        else:
            for k, action in zip(chosen.tolist(), actions, strict=True):
                requested[k] = action
        self.acting_s = time.perf_counter() - begin
        return requested

    def _observe(self, row: int, observation: Any, k: int) -> bool:
        """Let the filter of a row observe; return whether the actor may act."""
        safety = self.filters[row]
        observation = observation if self._measure is None else self._measure(row)
        age_s = 0.0 if self.ages_s is None else self.ages_s[k]
        command = safety.command
        before = None if command is None else command.position
        is_sound = safety.observe(observation, age_s)
        if command is not None and command.motion is not None and before is not None and command.position is not None:
            self._moved[row] += np.abs(command.position - before).sum(), np.abs(command.motion).sum()
        return is_sound

    def close(self) -> None:
        """Close the actor."""
        self.actor.close()

    def report(self, row: int) -> dict[str, Any]:
        """Return the actor's report with the episode's interventions per limit, faults, and motions of the joints."""
        counts = self.filters[row].counts - self._before[row]
        return {**self.actor.report(row), "interventions": dict(counts), "moved": self._moved[row].tolist()}
