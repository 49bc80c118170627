"""Touch: a planar arm of two joints brings its tip to a point."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rlctl.task import Box, Event, Sim, Task, events, rewards

# Beside this module, so that it is found wherever the package is installed.
MODEL = Path(__file__).with_name("planar_arm.urdf")
START = np.array([0.0, 1.0])  # [rad], elbow bent
MAX_SPEED = [3.0, 3.0]  # [rad/s], as in the model
HEIGHT = 0.05  # [m], of the plane the arm moves in


@dataclass
class Touch(Task):
    """Bring the tip within `tolerance` of the point and keep it there until the episode ends."""

    tolerance: float = 0.03  # [m]
    nearest: float = 0.2  # [m], points are this far from the shoulder
    farthest: float = 0.5  # [m], or this far; the arm reaches 0.6

    robot = "planar arm"
    control_dt, substeps, episode_s = 1 / 30, 4, 2.0  # [s], -, [s]
    action_space = Box(-1.0, 1.0, (2,), np.float32)
    action_meaning = "joint steps; 1 is the joint's top speed for one control step"
    observation_units = {"joint_positions": "rad", "joint_velocities": "rad/s", "to_point": "m", "point": "m"}
    reward_weights = {"distance": -1.0, "touching": 0.5, "action": -0.01}
    events = {"mass": Event("reset", events.scale_mass, body="arm", factor=(0.8, 1.2))}  # with `randomize: true`

    def build(self, sim: Sim) -> None:
        self.arm = sim.load("arm", MODEL, fixed=True)
        self.joint_step = np.array(MAX_SPEED) * self.control_dt  # [rad]

    def reset(self, rng: np.random.Generator) -> None:
        self.arm.set_joints(START + rng.uniform(-0.5, 0.5, 2))
        angle = rng.uniform(-math.pi / 2, math.pi / 2)
        radius = rng.uniform(self.nearest, self.farthest)
        self.point = np.array([radius * math.cos(angle), radius * math.sin(angle), HEIGHT])

    def act(self, action: np.ndarray) -> None:
        target = self.arm.joint_positions + self.joint_step * action
        target = np.clip(target, self.arm.joint_low, self.arm.joint_high)
        self.arm.drive_to(target, max_speed=MAX_SPEED, max_force=self.arm.joint_max_force.tolist(), gain=0.25)

    def observe(self) -> dict[str, np.ndarray]:
        return {
            "joint_positions": self.arm.joint_positions,
            "joint_velocities": self.arm.joint_velocities,
            "to_point": (self.point - self.arm.link_position("tip"))[:2],
            "point": self.point[:2],
        }

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        distance = self.distance()
        touching = float(distance < self.tolerance)
        return {"distance": distance, "touching": touching, "action": rewards.squared(action)}

    def distance(self) -> float:
        """Distance from the tip to the point [m]."""
        return rewards.distance(self.arm.link_position("tip"), self.point)

    def is_success(self) -> bool:
        return self.distance() < self.tolerance

    def markers(self) -> dict[str, np.ndarray]:
        return {"point": self.point}
