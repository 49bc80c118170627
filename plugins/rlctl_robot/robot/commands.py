"""The commands of a program as the robot gets them: in time, late, lost or invalid; the newest one acts."""

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl_robot.robot.comparison import CommandDifference


@dataclasses.dataclass
class CommandCounts:
    """What happened to the commands of the episodes with the same faults."""

    response_s: list[float] = dataclasses.field(default_factory=list)
    """Time from each observation to its command, as the program took it, without injected delays [s]."""
    late: int = 0  # commands after more than `control_dt`
    unanswered: int = 0  # observations whose command had not come when their episode ended
    lost: int = 0  # observations and commands that a fault dropped
    held: int = 0  # steps in which the action before acted again, because no newer command had come
    refused: int = 0  # messages that are no action
    first_problem: str = ""  # of them
    robot_late_s: list[float] = dataclasses.field(default_factory=list)
    """How much later than its time the robot itself began each step of `--realtime` [s]."""
    terminated: int = 0  # episodes that the task ended, such as because the robot fell
    tilted: int | None = None
    """Episodes at whose end the trunk was not upright, by the task's term `gravity`; None without that term."""
    compared: int = 0
    differences: list[CommandDifference] = dataclasses.field(default_factory=list)

    def quantiles(self) -> tuple[float, float, float]:
        """Return the median, the 99 % quantile and the largest of the response times [s]; NaN without any."""
        if not self.response_s:
            return math.nan, math.nan, math.nan
        p50, p99, worst = np.quantile(self.response_s, (0.5, 0.99, 1.0)).tolist()
        return p50, p99, worst


class CommandQueue:
    """Commands on their way to the robot. They may overtake each other: an older one never replaces a newer one."""

    def __init__(self) -> None:
        self._on_their_way: list[tuple[float, int, NDArray[Any]]] = []
        self._newest = 0

    def put(self, arrives_s: float, sequence: int, action: NDArray[Any]) -> None:
        """Send a command that arrives at a time of the episode [s]."""
        self._on_their_way.append((arrives_s, sequence, action))

    def take(self, before_s: float) -> NDArray[Any] | None:
        """Return the newest command that has arrived before a time; None if none is newer than the last."""
        arrived = [command for command in self._on_their_way if command[0] < before_s - 1e-9]
        if arrived:
            self._on_their_way = [command for command in self._on_their_way if command[0] >= before_s - 1e-9]
        newest = max(arrived, key=lambda command: command[1], default=None)
        if newest is None or newest[1] <= self._newest:
            return None
        self._newest = newest[1]
        return newest[2]
