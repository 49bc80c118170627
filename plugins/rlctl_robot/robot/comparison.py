"""How much the commands of a program differ from those of the policy that it should run."""

import collections
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.policy.policy import Policy
from rlctl_robot.robot.interface import Interface
from rlctl_robot.robot.program import SentObservation


@dataclasses.dataclass(frozen=True)
class CommandDifference:
    """The differences of one element of the commands, in its own unit."""

    name: str
    mean: float  # of the absolute differences
    largest: float
    episode: int  # of the largest
    step: int


class CommandComparison:
    """Lets the policy act on every observation that is sent, and compares the command for it.

    Observations that are not finite are left out: the policy has no answer to them.
    """

    def __init__(self, policy: Policy, interface: Interface, names: Sequence[str]) -> None:
        self._policy, self._interface, self._names = policy, interface, names
        self._frames: collections.deque[Any] = collections.deque(maxlen=policy.info.spec.frame_stack)
        self.reset()

    def reset(self) -> None:
        """Forget all differences."""
        self._episode = -1
        self._commands: dict[int, tuple[NDArray[Any], int, int]] = {}  # by sequence: with episode and step
        self._sum = np.zeros(len(self._names))
        self._largest = np.full(len(self._names), -1.0)
        self._where = [(0, 0)] * len(self._names)
        self.count = 0

    def observe(self, sent: SentObservation) -> None:
        """Let the policy act on an observation, as the program should."""
        if sent.episode != self._episode:
            self._episode = sent.episode
            self._policy.reset()
            self._interface.begin()
            self._frames.clear()
            self._commands.clear()
        if not all(np.isfinite(part).all() for part in sent.parts.values()):
            return
        observation = self._interface.observe(sent.parts, sent.step)
        if (frames := self._frames.maxlen or 1) > 1:
            self._frames.extend([observation] * (1 if self._frames else frames))
            observation = np.concatenate(self._frames, axis=-1)
        command = self._interface.find_command(self._policy.predict(observation), sent.parts, sent.step)
        self._commands[sent.sequence] = command, sent.episode, sent.step

    def compare(self, sequence: int, command: NDArray[Any]) -> None:
        """Compare the command for an observation."""
        if (expected := self._commands.pop(sequence, None)) is None:
            return
        own, episode, step = expected
        difference = np.abs(np.ravel(command).astype(float) - np.ravel(own))
        self.count += 1
        self._sum += difference
        for index in np.flatnonzero(difference > self._largest):
            self._largest[index], self._where[index] = difference[index], (episode, step)

    def differences(self) -> list[CommandDifference]:
        """Return the differences per element of the commands; empty if nothing was compared."""
        if not self.count:
            return []
        rows = zip(self._names, (self._sum / self.count).tolist(), self._largest.tolist(), self._where, strict=True)
        return [CommandDifference(name, mean, largest, *where) for name, mean, largest, where in rows]
