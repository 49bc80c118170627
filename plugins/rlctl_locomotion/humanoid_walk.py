"""Humanoid walk: a humanoid of 26 kg follows velocity commands in every direction, stepping in time with a clock."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from rlctl.task import Box, rewards, terms
from rlctl.task.rotations import rotate_inverse
from rlctl_locomotion.clocked import Clocked

LEG = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll")
JOINTS = [
    f"{side}_{joint}" for joints in (LEG, ("shoulder", "elbow")) for side in ("left", "right") for joint in joints
]
FEET = ("left_foot", "right_foot")
STANCE = np.array([0.0, 0.0, -0.3, 0.6, -0.3, 0.0] * 2 + [0.1, -0.5] * 2)  # [rad]
KEPT = np.array([name.split("_", 1)[1] in ("hip_yaw", "hip_roll", "shoulder", "elbow") for name in JOINTS])
OTHER_SIDE = (-7, -8, 9, 10, 11, -12, -1, -2, 3, 4, 5, -6, 15, 16, 13, 14)  # yaw and roll turn the other way
SOLE = 0.06  # [m], from an ankle to the ground


@dataclass
class HumanoidWalk(Clocked):
    """Walk forwards, sideways and turn as commanded, without falling; linear velocity is not observed."""

    tolerance: float = 0.2  # [m/s], largest mean error of the velocity in an episode that succeeds
    start_noise: float = 0.05  # [rad], of every joint, to each side of the stance

    robot = "humanoid of 26 kg"
    model: ClassVar[Path] = Path(__file__).with_name("models") / "humanoid_walk.xml"
    joint_order: ClassVar[list[str]] = JOINTS
    self_collision: ClassVar[bool] = True
    stance: ClassVar[np.ndarray] = STANCE
    reach: ClassVar[float] = 0.25
    period_s: ClassVar[float] = 0.7
    swing: ClassVar[float] = 0.07
    first_half: ClassVar[tuple[float, float]] = (1.0, -1.0)
    stiffness: ClassVar[np.ndarray] = np.array([80.0, 100.0, 100.0, 120.0, 60.0, 40.0] * 2 + [30.0, 30.0] * 2)
    damping: ClassVar[np.ndarray] = np.array([2.0, 3.0, 3.0, 3.0, 1.5, 1.0] * 2 + [1.0, 1.0] * 2)
    armature: ClassVar[float] = 0.02
    start_height: ClassVar[float] = 0.80
    target_height: ClassVar[float] = 0.78
    fallen_height: ClassVar[float] = 0.55
    lowest: ClassVar[np.ndarray] = np.array([-0.3, -0.3, -0.6])
    highest: ClassVar[np.ndarray] = np.array([0.8, 0.3, 0.6])

    action_space = Box(-4.0, 4.0, (16,), np.float32)
    observation_terms = {
        **Clocked.observation_terms,
        "joint_positions": terms.Scaled("joint_positions", offset=tuple(STANCE)),
    }
    reward_weights = {**Clocked.reward_weights, "tracking": 0.3, "turning": 0.15, "gait": 0.3, "pose": -0.3}
    per_world = {**Clocked.per_world, "last_action": (16,), "action_change": (16,)}
    mirror = {
        **Clocked.mirror,
        **dict.fromkeys(("joint_positions", "joint_velocities", "last_action", "action"), OTHER_SIDE),
        "velocity": (1, -2, 3),
        "height": (1,),
        "foot_heights": (2, 1),
        "events/push": (1, -2),  # speed and direction
    }
    rlctl_ignore = {**Clocked.rlctl_ignore, "RL610": "whoever is commanded to stand does so at first, and then falls"}

    def measure_feet(self) -> np.ndarray:
        """Return the heights of the soles above the ground [m], left and right, shape (worlds, 2)."""
        return np.stack([self.body.link_position(foot)[:, 2] - SOLE for foot in FEET], axis=1)

    def privileged(self) -> dict[str, np.ndarray]:
        """Return the velocity and the heights of trunk and feet."""
        velocity = rotate_inverse(self.body.base_orientation, self.body.base_velocity)
        return {"velocity": velocity, "height": self.measure_height()[:, None], "foot_heights": self.measure_feet()}

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Return what `Clocked` does, and how far hips and arms are from the stance."""
        bent = np.compress(KEPT, self.body.joint_positions - self.stance, axis=1)
        return {**super().rewards(action), "pose": rewards.squared(bent)}
