"""Humanoid walk: a humanoid of 26 kg follows velocity commands in every direction, stepping in time with a clock."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from rlctl.task import Box, WorldRngs, rewards, terms
from rlctl.task.rotations import rotate_inverse
from rlctl_locomotion.walk import Walk

LEG = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll")
JOINTS = [
    f"{side}_{joint}" for joints in (LEG, ("shoulder", "elbow")) for side in ("left", "right") for joint in joints
]
FEET = ("left_foot", "right_foot")
STANCE = np.array([0.0, 0.0, -0.3, 0.6, -0.3, 0.0] * 2 + [0.1, -0.5] * 2)  # [rad]
KEPT = np.array([name.split("_", 1)[1] in ("hip_yaw", "hip_roll", "shoulder", "elbow") for name in JOINTS])
OTHER_SIDE = (-7, -8, 9, 10, 11, -12, -1, -2, 3, 4, 5, -6, 15, 16, 13, 14)  # yaw and roll turn the other way
PERIOD_S = 0.7  # [s], of two steps
SOLE = 0.06  # [m], from an ankle to the ground
SWING = 0.07  # [m], how high a foot is lifted
LEAST_SWING = 0.01  # [m]; a foot that is lower near the top of its swing has missed its step


@dataclass
class HumanoidWalk(Walk):
    """Walk forwards, sideways and turn as commanded, without falling; linear velocity is not observed."""

    tolerance: float = 0.2  # [m/s], largest mean error of the velocity in an episode that succeeds
    start_noise: float = 0.05  # [rad], of every joint, to each side of the stance

    phase: np.ndarray = field(init=False, repr=False)  # sine and cosine; the left foot swings while the sine is above 0

    robot = "humanoid of 26 kg"
    model: ClassVar[Path] = Path(__file__).with_name("models") / "humanoid_walk.xml"
    joint_order: ClassVar[list[str]] = JOINTS
    self_collision: ClassVar[bool] = True
    stance: ClassVar[np.ndarray] = STANCE
    reach: ClassVar[float] = 0.25
    stiffness: ClassVar[np.ndarray] = np.array([80.0, 100.0, 100.0, 120.0, 60.0, 40.0] * 2 + [30.0, 30.0] * 2)
    damping: ClassVar[np.ndarray] = np.array([2.0, 3.0, 3.0, 3.0, 1.5, 1.0] * 2 + [1.0, 1.0] * 2)
    armature: ClassVar[float] = 0.02
    start_height: ClassVar[float] = 0.80
    target_height: ClassVar[float] = 0.78
    fallen_height: ClassVar[float] = 0.55
    lowest: ClassVar[np.ndarray] = np.array([-0.3, -0.3, -0.6])
    highest: ClassVar[np.ndarray] = np.array([0.8, 0.3, 0.6])

    action_space = Box(-4.0, 4.0, (16,), np.float32)
    observation_units = {**Walk.observation_units, "phase": "sine and cosine"}
    observation_terms = {
        **Walk.observation_terms,
        "joint_positions": terms.Scaled("joint_positions", offset=tuple(STANCE)),
    }
    reward_weights = {**Walk.reward_weights, "tracking": 0.3, "turning": 0.15, "gait": 0.3, "pose": -0.3}
    per_world = {**Walk.per_world, "last_action": (16,), "action_change": (16,), "phase": (2,)}
    mirror = {
        **Walk.mirror,
        **dict.fromkeys(("joint_positions", "joint_velocities", "last_action", "action"), OTHER_SIDE),
        "phase": (-1, -2),
        "velocity": (1, -2, 3),
        "height": (1,),
        "foot_heights": (2, 1),
    }
    rlctl_ignore = {**Walk.rlctl_ignore, "RL610": "whoever is commanded to stand does so at first, and then falls"}

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        """Stand, with a commanded velocity, about to lift the left or the right foot."""
        super().reset(rng, worlds)
        self.phase[worlds, 1] = np.sign(rng.uniform(-1.0, 1.0))

    def act(self, action: np.ndarray) -> None:
        """Set the joints' target angles; the clock runs on."""
        super().act(action)
        turn = 2 * np.pi * self.control_dt / PERIOD_S
        sine, cosine = self.phase.T
        self.phase = np.stack(
            [sine * np.cos(turn) + cosine * np.sin(turn), cosine * np.cos(turn) - sine * np.sin(turn)], -1
        )

    def is_terminated(self) -> np.ndarray:
        """It has fallen, or missed a step: standing is easier than walking, and nothing else makes it lift a foot."""
        return super().is_terminated()

    def measure(self) -> None:
        """Compute what rewards, success and the end share, once per step."""
        super().measure()
        self.foot_heights = self.measure_feet()
        self.wanted = SWING * np.maximum(self.phase[:, :1] * (1.0, -1.0), 0.0)  # [m], of the soles
        missed = (self.wanted > 0.9 * SWING) & (self.foot_heights < LEAST_SWING)
        self.fallen |= missed.any(axis=1)

    def measure_feet(self) -> np.ndarray:
        """Return the heights of the soles above the ground [m], left and right, shape (worlds, 2)."""
        return np.stack([self.body.link_position(foot)[:, 2] - SOLE for foot in FEET], axis=1)

    def observe_command(self) -> dict[str, np.ndarray]:
        """Return the commanded velocities, and the clock's phase."""
        return {**super().observe_command(), "phase": self.phase}

    def privileged(self) -> dict[str, np.ndarray]:
        """Return the velocity and the heights of trunk and feet."""
        velocity = rotate_inverse(self.body.base_orientation, self.body.base_velocity)
        return {"velocity": velocity, "height": self.measure_height()[:, None], "foot_heights": self.measure_feet()}

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Return how well command and clock are followed, and how calmly."""
        bent = np.compress(KEPT, self.body.joint_positions - self.stance, axis=1)
        return {
            **super().rewards(action),
            "gait": 1.0 - np.abs(self.foot_heights - self.wanted).mean(axis=1) / SWING,
            "pose": rewards.squared(bent),
        }
