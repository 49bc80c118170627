"""A small arm driven by torques, whose events have hidden values in the tests."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rlctl.task import Box, Event, Joints, Sim, Task, events


@dataclass
class Arm(Task):
    """Hang and move."""

    control_dt, substeps, episode_s = 0.02, 4, 4.0
    action_space = Box(-1.0, 1.0, (2,), np.float32)
    reward_weights = {"nothing": 1.0}
    events = {
        "mass": Event("reset", events.scale_mass, body="arm", factor=(0.7, 1.4)),
        "damping": Event("reset", events.scale_joint_damping, body="arm", factor=(0.5, 2.0)),
        "strength": Event("reset", events.scale_motor_strength, body="arm", factor=(0.7, 1.0)),
        "friction": Event("reset", events.set_friction, body="arm", friction=(0.2, 1.0)),
        "late": Event("action", events.delay, steps=(0, 2)),
        "noise": Event("observation", events.noise, std=(0.0, 0.1)),
    }

    def build(self, sim: Sim) -> None:
        self.arm = sim.load("arm", Path(__file__).with_name("arm.urdf"), position=(0, 0, 2), fixed=True)
        self.arm.disable_motors()

    def reset(self, rng: np.random.Generator) -> None:
        self.arm.set_joints(np.zeros(2))

    def act(self, action: np.ndarray) -> None:
        self.arm.set_torques(np.array([4.0, 1.5]) * action)

    def observe(self) -> dict[str, np.ndarray]:
        return {"positions": self.arm.joint_positions, "velocities": self.arm.joint_velocities}

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        return {"nothing": 0.0}

    def describe_joints(self) -> Joints:
        return self.arm.describe_joints(["shoulder", "elbow"])
