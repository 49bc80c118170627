"""An actor within the limits of a safety filter, in simulation and in a server."""

import collections
from typing import Any

import numpy as np

from rlctl.environments.dict_spaces import map_parts, take_row
from rlctl.environments.info import EnvInfo
from rlctl.limits.limits import Limits
from rlctl.limits.safety_filter import SafetyFilter
from rlctl.policy.actor import Actor, Array, Exploration, Rows, as_stored


class Limited(Actor):
    """Passes the actions of another actor through a safety filter per row; reports the number of interventions."""

    def __init__(self, actor: Actor, info: EnvInfo, limits: Limits | None, count: int = 1) -> None:
        self._actor = actor
        self.filters = [SafetyFilter(info, limits) for _ in range(count)]
        self._before = [collections.Counter[str]() for _ in range(count)]
        self._moved = np.zeros((count, 2))  # sums of the joints' measured and commanded motions in each episode

    @property
    def state(self) -> Array | None:
        """Recurrent states of the actor."""
        return self._actor.state

    def explore(self, exploration: Exploration) -> None:
        """Let the actor explore."""
        self._actor.explore(exploration)

    def prepare(self) -> None:
        """Begin a segment."""
        self._actor.prepare()

    def begin(self, rows: Rows) -> None:
        """Begin episodes, and end what the limits hold."""
        self._actor.begin(rows)
        for row in rows.index.tolist():
            safety = self.filters[row]
            safety.resume()
            safety.reset()
            self._before[row], self._moved[row] = safety.counts, 0.0

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the limited actions, to record and to step with; the actor acts where it may."""
        places = rows.index.tolist()
        is_sound = np.array([self._observe(row, take_row(observations, k)) for k, row in enumerate(places)])
        requested = iter(())
        if is_sound.any():
            sound = map_parts(lambda part: part[is_sound], observations)
            requested = iter(self._actor.act(sound, rows.select(is_sound))[1])
        actions = [
            self.filters[row].limit(next(requested) if sound else None)
            for row, sound in zip(places, is_sound.tolist(), strict=True)
        ]
        return as_stored(limited := np.stack(actions)), limited

    def _observe(self, row: int, observation: Any) -> bool:
        """Let the filter of a row observe; return whether the actor may act."""
        safety = self.filters[row]
        command = safety.command
        before = None if command is None else command.position
        is_sound = safety.observe(observation)
        if command is not None and command.motion is not None and before is not None and command.position is not None:
            self._moved[row] += np.abs(command.position - before).sum(), np.abs(command.motion).sum()
        return is_sound

    def close(self) -> None:
        """Close the actor."""
        self._actor.close()

    def report(self, row: int) -> dict[str, Any]:
        """Return the actor's report with the episode's interventions per limit, faults, and motions of the joints."""
        counts = self.filters[row].counts - self._before[row]
        return {**self._actor.report(row), "interventions": dict(counts), "moved": self._moved[row].tolist()}
