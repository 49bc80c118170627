"""Reach with a reward that says only whether the goal is reached: for hindsight experience replay."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from rlctl.task import Event, Joints, events
from rlctl_manipulation.reach import HAND, HOME, Reach

STRICT = 0.02  # [m]


@dataclass
class ReachSparse(Reach):
    """Bring the hand within `tolerance` of the goal; every step away from it costs 1."""

    observation_layout = "dict"
    observation_units = {"achieved_goal": "m", "desired_goal": "m"}
    observation_terms = {}
    reward_weights = {"away": -1.0, "within_2_cm": 0.0, "distance": 0.0}
    events = {
        name: event for name, event in Reach.events.items() if not name.endswith("noise") or name == "action_noise"
    } | {
        "state_noise": Event("observation", events.noise, of="observation", std=(0.0, 0.01)),  # rad, rad/s
        # Of a camera [m]. The hand is known from the joints; its noise is theirs.
        "goal_noise": Event("observation", events.noise, of="desired_goal", std=(0.0, 0.005)),
    }

    def observe(self) -> dict[str, np.ndarray]:
        """Return the arm's state, where the hand is, and where it should be."""
        return {
            "observation": np.concatenate([self.arm.joint_positions, self.arm.joint_velocities]),
            "achieved_goal": self.arm.link_position(HAND),
            "desired_goal": self.goal,
        }

    def describe_joints(self) -> Joints:
        """The arm's, without the steps that actions command: no observation has the joints' positions alone."""
        return self.arm.describe_joints(self.arm.joint_names, default_positions=HOME.tolist())

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        """Return 1 for every step away from the goal; how far away, and within 2 cm or not, is not rewarded."""
        distance = self.distance()
        away, strict = float(distance >= self.tolerance), float(distance < STRICT)
        return {"away": away, "within_2_cm": strict, "distance": distance}

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """Return -1 away from the goal, 0 at it."""
        distance = np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        return np.where(distance < self.tolerance, 0.0, -1.0)
