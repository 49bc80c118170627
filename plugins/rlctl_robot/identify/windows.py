"""Plays windows of a log in many worlds at once: the servos' commands in, what the encoders would read out."""

from typing import Any

import numpy as np

from rlctl_robot.identify.log import Array
from rlctl_robot.identify.robot_model import (
    ARMATURE,
    BACKLASH,
    BIAS,
    COULOMB,
    DAMPING,
    DELAY,
    MASS,
    STIFFNESS,
    TORQUE,
    VISCOUS,
    RobotModel,
    Values,
)

_MOST_WORLDS = 4096  # at once


class WindowPlayer:
    """Simulates commands in batches of worlds, each with its own values, start and window."""

    def __init__(self, robot: RobotModel, commands: Array, control_dt: float, threads: int = 0) -> None:
        """`commands` [rad or m], shape (rows, joints), are those of the log, in the frame of the encoders."""
        self.robot, self.control_dt = robot, control_dt
        self._commands, self._threads = commands, threads
        self.sides = np.zeros_like(commands)
        """Side of its play, -1 to 1, on which each link lies in each row: where a window begins."""
        self.is_unstable = np.zeros(0, bool)
        """Whether each of the worlds played last was unstable, so that MuJoCo put it back to its first position."""
        self.substeps = max(1, int(np.ceil(control_dt / robot.model.opt.timestep - 1e-6)))
        self._batches: dict[int, Any] = {}

    def play(self, values: Values, first: Array, positions: Array, velocities: Array, steps: int) -> Array:
        """Return what the encoders read [rad or m], shape (worlds, steps + 1, joints).

        `values` have a leading axis of worlds; `first` is each world's first row in the log, `positions` (as the
        encoders read them) and `velocities`, shape (worlds, joints), the state in that row.
        """
        parts = []
        self.is_unstable = np.zeros(len(first), bool)
        for begin in range(0, len(first), _MOST_WORLDS):
            rows = slice(begin, begin + _MOST_WORLDS)
            some = {name: value[rows] for name, value in values.items()}
            parts.append(self._play_batch(some, first[rows], positions[rows], velocities[rows], steps))
            self.is_unstable[rows] = self._batches[len(first[rows])].warning[..., 1].any(axis=1)
        return np.concatenate(parts)

    def _play_batch(self, values: Values, first: Array, positions: Array, velocities: Array, steps: int) -> Array:
        batch, bias = self._prepare(values, len(first)), values[BIAS]
        places, plays = self.robot.places, self.robot.play_places
        batch.bind("qpos")[:, places] = positions - bias
        batch.bind("qvel")[:, places] = velocities
        if len(plays):
            batch.bind("qpos")[:, plays] = values[BACKLASH] / 2 * self.sides[first]
        batch.warning[:] = 0  # the last value and the number of each
        played = np.empty((len(first), steps + 1, positions.shape[1]))
        played[:, 0] = positions
        for step in range(steps):
            controls = self._find_commands(first + step, values[DELAY]) - bias[:, None]
            batch.rollout(self.substeps, controls, record=[])
            played[:, step + 1] = batch.bind("qpos")[:, places] + bias
        return played

    def _prepare(self, values: Values, count: int) -> Any:
        from mujoco.batch import Batch

        model = self.robot.model
        model.opt.timestep = self.control_dt / self.substeps
        if count not in self._batches:
            self._batches[count] = Batch(model, count, self._threads)
        batch = self._batches[count]
        places, plays = self.robot.places, self.robot.play_places
        batch.expand("dof_armature")[:, places] = values[ARMATURE]
        batch.expand("dof_damping")[:, places] = values[VISCOUS]
        batch.expand("dof_frictionloss")[:, places] = values[COULOMB]
        batch.expand("actuator_forcerange")[:] = values[TORQUE][..., None] * [-1.0, 1.0]
        if len(plays):
            half = values[BACKLASH] / 2
            batch.expand("jnt_range")[:, plays] = np.stack([-half, half], axis=-1)
        batch.expand("actuator_gainprm")[:, :, 0] = values[STIFFNESS]
        batch.expand("actuator_biasprm")[:, :, 1] = -values[STIFFNESS]
        batch.expand("actuator_biasprm")[:, :, 2] = -values[DAMPING]
        if np.any(values[MASS] != 1.0):
            batch.expand("body_mass")[:] = values[MASS] * model.body_mass
            batch.expand("body_inertia")[:] = values[MASS][..., None] * model.body_inertia
        batch.reset(stage=0)
        batch.set_const()  # what MuJoCo derives from inertias, as when it compiles a file with these values
        return batch

    def _find_commands(self, rows: Array, delay: Array) -> Array:
        """Return the commands of the substeps that follow the rows, shape (worlds, substeps, joints).

        A delay need not be a number of substeps: a substep in which the command changes has the mean over its time.
        """
        length = 1.0 / self.substeps  # of a substep, in control steps
        begin = rows[:, None] + np.arange(self.substeps) * length - (delay / self.control_dt)[:, None]
        row = np.floor(begin + 1e-9)
        later = np.clip((begin + length - (row + 1)) / length, 0.0, 1.0)[..., None]
        last = len(self._commands) - 1
        now, then = (np.clip(row + step, 0, last).astype(int) for step in (0, 1))
        commands: Array = self._commands[now] * (1.0 - later) + self._commands[then] * later
        return commands
