"""Walk: Unitree's A1 follows velocity commands in every direction, in many worlds at once."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from rlctl.task import CommandTerm, Event, WorldRngs, events, rewards
from rlctl_locomotion.driven import Driven

VELOCITIES = {"lin_vel_x": "m/s", "lin_vel_y": "m/s", "ang_vel_z": "rad/s"}  # names and units of what is commanded


@dataclass
class Walk(Driven):
    """Walk forwards, sideways and turn as commanded, without falling; linear velocity is not observed."""

    tolerance: float = 0.2  # [m/s], largest mean error of the velocity in an episode that succeeds
    start_noise: float = 0.1  # [rad], of every joint, to each side of the stance
    episode_s: float = 10.0

    command: np.ndarray = field(init=False, repr=False)  # velocities forwards, sideways [m/s] and of turning [rad/s]
    error_sum: np.ndarray = field(init=False, repr=False)  # [m/s], over the steps of the episode

    lowest: ClassVar[np.ndarray] = np.array([-0.5, -0.4, -0.8])  # commanded velocities: forwards, sideways, turning
    highest: ClassVar[np.ndarray] = np.array([1.0, 0.4, 0.8])
    fallen_height: ClassVar[float] = 0.14  # [m], of the trunk
    scale = 0.5  # [m/s] and [rad/s]; so far from the command, tracking is worth 1/e

    observation_units = {**Driven.observation_units, "command": "m/s, m/s, rad/s"}
    reward_weights = {
        "tracking": 0.1,
        "turning": 0.05,
        "bounce": -0.03,
        "sway": -0.005,
        "smoothness": -0.012,
        "posture": -0.2,
        "height": -2.0,
        "fall": -1.0,
        "velocity_error": 0.0,  # a metric [m/s]
    }
    per_world = {**Driven.per_world, "command": (3,), "error_sum": ()}
    mirror = {**Driven.mirror, "command": (1, -2, -3)}
    events = {
        **Driven.events,
        "push": Event("interval", events.kick, every_s=4.0, body="robot", speed=(0.0, 0.7)),  # [m/s]
    }
    rlctl_ignore = {
        "RL106": "action 1 is 0.25 rad, about what it needs; up to 4 it may target angles out of reach, for force",
        "RL611": "following a command is what training is for; random actions stay where they are",
    }

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        """Stand, with a commanded velocity."""
        start = self.draw_place(rng, worlds)
        self.body.set_base(start, worlds=worlds)
        noise = rng.uniform(-self.start_noise, self.start_noise, len(self.stance))
        self.body.set_joints(self.stance + noise, worlds=worlds)
        self.command[worlds] = rng.uniform(self.lowest, self.highest)

    def draw_place(self, rng: WorldRngs, worlds: np.ndarray) -> np.ndarray:
        """Return where the trunk starts [m], shape (k, 3)."""
        return np.tile([0.0, 0.0, self.start_height], (len(worlds), 1))

    def is_terminated(self) -> np.ndarray:
        """It has fallen: upside down, or with its trunk near the ground."""
        self.measure()
        return self.fallen

    def measure(self) -> None:
        """Compute what rewards, success and the end share, once per step."""
        super().measure()
        self.fallen = (self.gravity[:, 2] > -0.5) | (self.height < self.fallen_height)
        self.error = np.linalg.norm(self.command[:, :2] - self.velocity[:, :2], axis=1)  # [m/s]
        self.error_sum += self.error

    def observe_command(self) -> dict[str, np.ndarray]:
        """Return the commanded velocities."""
        return {"command": self.command}

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Return how well the command is followed, and how calmly."""
        return {
            "tracking": rewards.closeness(self.error, self.scale),
            "turning": rewards.closeness(self.command[:, 2] - self.turning[:, 2], self.scale),
            "bounce": self.velocity[:, 2] ** 2,
            "sway": np.sum(self.turning[:, :2] ** 2, axis=1),
            "smoothness": rewards.squared(self.action_change),
            "posture": np.sum(self.gravity[:, :2] ** 2, axis=1),
            "height": (self.height - self.target_height) ** 2,
            "fall": self.fallen.astype(float),
            "velocity_error": self.error,
        }

    def is_success(self) -> np.ndarray:
        """It is up, and on average within `tolerance` of the commanded velocity."""
        return ~self.fallen & (self.error_sum <= self.tolerance * np.maximum(self.steps, 1))

    def commands(self) -> dict[str, CommandTerm]:
        """Return the commanded velocities: forwards, to the left, and of turning to the left."""
        rows = zip(VELOCITIES.items(), self.command.T, self.lowest.tolist(), self.highest.tolist(), strict=True)
        return {name: CommandTerm(values, low, high, unit, True) for (name, unit), values, low, high in rows}

    def set_commands(self, values: Mapping[str, np.ndarray]) -> None:
        """Set commanded velocities."""
        for name, value in values.items():
            self.command[:, list(VELOCITIES).index(name)] = value
