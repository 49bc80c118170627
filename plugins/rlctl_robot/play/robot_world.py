"""What a person can do to a task's world: command the robot, push it, change the ground's friction."""

import math
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from rlctl.errors import TaskError, short_repr
from rlctl.task.body import Body
from rlctl.task.commands import CommandTerm
from rlctl.task.env import TaskEnv
from rlctl_robot.play.controls import Wishes

_PUSH_S = 0.1
_PUSH_SPEED = 0.5  # [m/s], by which a push changes the speed of the whole robot


class RobotWorld:
    """The world of an environment; of a plain one a person can only start and stop the clock."""

    def __init__(self, env: Any) -> None:
        inner = env.unwrapped
        self._env = inner if isinstance(inner, TaskEnv) else None
        bodies = [] if self._env is None else list(self._env.sim.bodies.values())
        robots = [body for body in bodies if body.joint_names]
        self._robot = max(robots, key=lambda body: body.total_mass(), default=None)
        self._grounds = [body.name for body in bodies if body.fixed and not body.joint_names]
        self._friction: float | None = None
        self._trunk = None if self._robot is None else self._robot.find_trunk()

    @property
    def can_push(self) -> bool:
        """Whether there is a robot to push."""
        return self._robot is not None

    @property
    def can_change_friction(self) -> bool:
        """Whether there is a ground."""
        return bool(self._grounds)

    def remove_time_limit(self) -> None:
        """Let an episode of a task last until the person ends it."""
        if self._env is not None:
            self._env.max_steps = sys.maxsize

    def commands(self) -> dict[str, CommandTerm]:
        """Return the task's commands; raises `TaskError` for one that is not finite or has no range."""
        commands = {} if self._env is None else self._env.commands()
        for name, command in commands.items():
            if not (math.isfinite(command.value) and command.low < command.high):
                raise TaskError(f"commands(): {name} is {short_repr(tuple(command))}; give a value, and low < high")
        return commands

    def begin(self) -> None:
        """Begin an episode: the built world has its own friction again."""
        self._friction = None

    def apply(self, wishes: Wishes) -> list[str]:
        """Do what the person wants; return what to write into the log."""
        log = []
        if self._env is not None and wishes.commands:
            self._set_commands(self._env, wishes.commands)
        if self._env is not None and wishes.friction is not None and wishes.friction != self._friction:
            self._friction = wishes.friction
            for name in self._grounds:
                self._env.sim.body(name).set_friction(wishes.friction)
            log.append(f"friction of the ground {wishes.friction:g}")
        if self._env is not None and self._robot is not None and wishes.push is not None and any(wishes.push):
            log.append(self._push(self._env, self._find_robot(self._env, self._robot), wishes.push))
        return log

    def _set_commands(self, env: TaskEnv, wanted: Mapping[str, float]) -> None:
        known = env.commands()
        values = {
            name: min(max(value, known[name].low), known[name].high) for name, value in wanted.items() if name in known
        }
        if any(known[name].value != value for name, value in values.items()):
            env.set_commands(values)

    def _find_robot(self, env: TaskEnv, robot: Body) -> Body:
        return env.sim.body(robot.name)  # a reset may have loaded it again

    def _push(self, env: TaskEnv, robot: Body, direction: tuple[float, float]) -> str:
        """Push the trunk, or the last link of a robot that is fixed to the ground."""
        link = self._trunk or robot.link_names[-1]
        largest = max(abs(part) for part in direction)  # divided by first: a square may be too large or small
        scaled = np.array(direction) / largest
        force = robot.total_mass() * _PUSH_SPEED / _PUSH_S * scaled / np.linalg.norm(scaled)
        env.sim.push(robot.name, [*force.tolist(), 0.0], _PUSH_S, None if link == robot.base_name else link)
        return f"push of {np.linalg.norm(force):.3g} N for {_PUSH_S:g} s"

    def find_center(self) -> list[float] | None:
        """Return where the robot is [m], for the camera; None for one that stays where it is."""
        if self._env is None or self._robot is None or self._trunk is None:
            return None
        robot = self._find_robot(self._env, self._robot)
        at_base = self._trunk == robot.base_name
        position = robot.base_position if at_base else robot.link_position(self._trunk)
        return [float(value) for value in position]
