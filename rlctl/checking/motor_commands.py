"""What an environment writes for the motors of a world, as a function of its actions and of the joints' state."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import Array, Motor, WrittenCommand

FEWEST_ROWS = 40
MORE_ROWS = 15  # than a fit has parameters, so that it proves something
SAME = 1e-5  # relative; a command is a function of something if it differs by no more


@dataclasses.dataclass(frozen=True)
class CommandSpan:
    """The commands that all actions of the space give a motor: from `low` to `high`, by one element of the action."""

    motor: Motor
    number: int
    element: int
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class MotorCommands:
    """What was written for the motors of a world, step by step."""

    motors: tuple[Motor, ...]
    values: Array  # Shape (n, motors)
    actions: Array  # Shape (n, k)
    states: tuple[tuple[Array, Array], ...]  # positions and speeds that the environment may have read, (n, motors) each
    starts: Array  # A column per episode, 1 in its rows. Shape (n, episodes)
    low: Array  # Of the action. Shape (k,)
    high: Array

    @classmethod
    def read(cls, world: LoggedWorld, low: Array, high: Array) -> "MotorCommands | None":
        """Return what the logs have; None if they have too little."""
        rows = [
            (number, log.given[i], command)
            for number, log in enumerate(world.logs)
            for i, command in enumerate(log.commands)
            if command is not None and log.actions in ("random", "zero") and log.given[i].size == low.size
        ]
        if len(rows) < FEWEST_ROWS or not low.size:
            return None
        episodes, actions, commands = zip(*rows, strict=True)
        starts = (np.array(episodes)[:, None] == np.unique(episodes)).astype(float)

        def stack(read: Callable[[WrittenCommand], Array]) -> Array:
            return np.nan_to_num(np.stack([read(command) for command in commands]))

        last = stack(lambda c: c.positions), stack(lambda c: c.speeds)
        first = stack(lambda c: c.first_positions), stack(lambda c: c.first_speeds)
        return cls(world.world.motors, stack(lambda c: c.values), np.stack(actions), (last, first), starts, low, high)

    def _free_rows(self, motor: int) -> NDArray[np.bool_]:
        """Return the rows in which a command is not at an end where it is clipped."""
        values = self.values[:, motor]
        free = np.ones(len(values), np.bool_)
        for end in (values.min(), values.max()):
            free &= (values != end) | ((values == end).sum() < 3)
        return free

    def find_spans(self) -> list[CommandSpan]:
        """Return the spans of motors whose command is a linear function of one element of the action, and of nothing
        else."""
        spans = []
        design = np.column_stack([self.actions, np.ones(len(self.actions))])
        fitted = np.linalg.lstsq(design, self.values, rcond=None)[0]
        rest = np.abs(self.values - design @ fitted).max(axis=0)
        for number, motor in enumerate(self.motors):
            slopes, size = np.abs(fitted[:-1, number]), np.abs(self.values[:, number]).max()
            element = int(slopes.argmax())
            is_alone = slopes[element] > 0 and (np.delete(slopes, element) <= SAME * slopes[element]).all()
            bounds = np.array([self.low[element], self.high[element]])
            if rest[number] <= SAME * size and is_alone and np.isfinite(bounds).all():
                ends = (fitted[-1, number] + fitted[element, number] * bounds).tolist()
                spans.append(CommandSpan(motor, number, element, min(ends), max(ends)))
        return spans

    def find_rest(self, motor: int, position: int | None, *speeds_of: int) -> float:
        """Return the part of a command that the action, the position of one motor's joint, and the speeds of some, do
        not explain."""
        free = self._free_rows(motor)
        values, rests = self.values[free, motor], []
        is_few = len(values) < MORE_ROWS + self.actions.shape[1] + self.starts.shape[1] + 3
        design = np.column_stack([self.actions, np.ones(len(free)) if is_few else self.starts])[free]
        for positions, speeds in self.states:
            own = [] if position is None else [positions[free, position]]
            columns = np.column_stack([design, *own, speeds[free][:, list(speeds_of)]])
            if len(values) < MORE_ROWS + columns.shape[1] or values.std() == 0:
                return math.nan
            fitted = np.linalg.lstsq(columns, values, rcond=None)[0]
            rests.append(float(np.abs(values - columns @ fitted).max() / values.std()))
        return min(rests)
