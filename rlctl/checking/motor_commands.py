"""What an environment writes for the motors of a world, as a function of its actions."""

import dataclasses

import numpy as np

from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import Array, JointActuator

FEWEST_ROWS = 40
SAME = 1e-5  # relative; a command is a function of something if it differs by no more


@dataclasses.dataclass(frozen=True)
class CommandSpan:
    """The commands that all actions of the space give a motor: from `low` to `high`, by one element of the action."""

    motor: JointActuator
    element: int
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class MotorCommands:
    """What was written for the motors of a world, step by step."""

    motors: tuple[JointActuator, ...]
    values: Array  # Shape (n, motors)
    actions: Array  # Shape (n, k)
    low: Array  # Of the action. Shape (k,)
    high: Array

    @classmethod
    def read(cls, world: LoggedWorld, low: Array, high: Array) -> "MotorCommands | None":
        """Return what the logs have; None if they have too little."""
        rows = [
            (log.given[i], command)
            for log in world.logs
            for i, command in enumerate(log.commands)
            if command is not None and log.actions in ("random", "zero") and log.given[i].size == low.size
        ]
        if len(rows) < FEWEST_ROWS or not low.size:
            return None
        actions, commands = zip(*rows, strict=True)
        return cls(world.world.motors, np.nan_to_num(np.stack(commands)), np.stack(actions), low, high)

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
                spans.append(CommandSpan(motor, element, min(ends), max(ends)))
        return spans
