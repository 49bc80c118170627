"""A player within the limits of a safety filter: what `rlctl eval --limits` plays."""

import collections
from typing import Any

import numpy as np

from rlctl.environments.info import EnvInfo
from rlctl.limits.limits import Limits
from rlctl.limits.safety_filter import SafetyFilter
from rlctl.policy.players.player import Exploration, Player


class LimitedPlayer(Player):
    """Plays another player's actions within limits; reports the number of interventions."""

    def __init__(self, player: Player, info: EnvInfo, limits: Limits) -> None:
        self._player = player
        self._safety = SafetyFilter(info, limits)
        self._before: collections.Counter[str] = collections.Counter()
        self._moved = np.zeros(2)  # sums of the joints' measured and commanded motions in this episode

    @property
    def state(self) -> Any:
        """Recurrent state of the player."""
        return self._player.state

    def explore(self, exploration: Exploration) -> None:
        """Let the player explore."""
        self._player.explore(exploration)

    def begin_segment(self, seed: int, step: int) -> None:
        """Begin a segment at a step of an episode."""
        self._player.begin_segment(seed, step)

    def act(self, observation: Any, seed: int, step: int) -> tuple[Any, Any]:
        """Return the limited action twice, to record and to step with."""
        if step == 0:
            self._safety.resume()
            self._safety.reset()
            self._before, self._moved = self._safety.counts, np.zeros(2)
        command = self._safety.command
        before = None if command is None else command.position
        is_sound = self._safety.observe(observation)
        if command is not None and command.motion is not None and before is not None and command.position is not None:
            self._moved += np.abs(command.position - before).sum(), np.abs(command.motion).sum()
        action = self._safety.limit(self._player.act(observation, seed, step)[1] if is_sound else None)
        return action, action

    def close(self) -> None:
        """Close the player."""
        self._player.close()

    def report(self) -> dict[str, Any]:
        """Return the player's report with this episode's interventions per limit, faults, and motions of the joints."""
        limited = {"interventions": dict(self._safety.counts - self._before), "moved": self._moved.tolist()}
        return {**self._player.report(), **limited}
