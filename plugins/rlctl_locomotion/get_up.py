"""Get up: Unitree's A1 lies on the ground as it fell, gets up to its stance and stands still."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from rlctl.task import Sim, WorldRngs, rewards
from rlctl.task.rotations import from_axis, multiply, rotate
from rlctl_locomotion.driven import Driven
from rlctl_locomotion.quadruped import FEET, LEGS

LIMP_S = 0.5  # [s] at the start of a fall
CALM = 0.3  # [m/s], of the trunk; a turn of 1 rad/s counts as 0.2 m/s
STILL_S = 0.5  # [s], for which it stands still before the end of an episode that succeeds
CORNERS = np.stack(np.meshgrid((-0.23, 0.23), (-0.15, 0.15), (-0.06, 0.06)), -1).reshape(
    -1, 3
)  # [m], of trunk and hips
THICKNESS = 0.03  # [m], of legs at knees and feet
PARTS = (*(f"{leg}_lower" for leg in LEGS), *FEET)  # whose frames are at knees and feet


@dataclass
class GetUp(Driven):
    """Get up from any pose, and stand still."""

    episode_s: float = 5.0

    still: np.ndarray = field(init=False, repr=False)  # steps since which it stands still
    limp: np.ndarray = field(init=False, repr=False)  # [s] at the start, in which the motors are off

    # Random actions of 40 ms move it farther than those of 20. With 3 iterations of the solver it could leap 2 metres.
    control_dt, substeps, solver_iterations = 0.04, 8, 10  # [s], -, -
    reach: ClassVar[np.ndarray] = np.array([0.3, 0.6, 0.3] * 4)  # [rad]; a foot reaches the ground behind the back
    action_meaning = "joint angles from the stance; 1 is 0.6 rad of an upper leg, 0.3 of a hip or a lower leg"
    reward_weights = {
        "upright": 0.2,
        "height": 0.15,
        "stance": 0.15,
        "still": 0.3,
        "idle": -0.2,
        "rest": -0.01,
        "smoothness": -0.002,
        "motion": -0.0001,
        "is_up": 0.0,  # a metric
    }
    per_world = {**Driven.per_world, "still": (), "limp": ()}

    rlctl_ignore = {
        "RL106": "action 1 is 0.3 or 0.6 rad; up to 4 it may target angles out of reach, for force",
    }

    def build(self, sim: Sim) -> None:
        """Load the ground and the robot."""
        super().build(sim)
        self.low, self.high = self.body.joint_low[self.joints], self.body.joint_high[self.joints]

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        """Fall on back, belly or side, from just above the ground, with joints anywhere within their limits.

        At level 0.6 four in ten episodes begin between that and the upright stance, with the motors on.
        """
        roll, pitch, yaw, luck, share = rng.uniform((-np.pi, -0.5, -np.pi, 0.0, 0.0), (np.pi, 0.5, np.pi, 1.0, 1.0)).T
        share = np.where(luck < self.level[worlds], 1.0, share)
        self.limp[worlds] = np.where(share == 1.0, LIMP_S, 0.0)
        roll, pitch = roll * share, pitch * share
        tilt = multiply(from_axis((0, 1, 0), pitch), from_axis((1, 0, 0), roll))
        place, orientation = np.tile([0.0, 0.0, 1.0], (len(worlds), 1)), multiply(from_axis((0, 0, 1), yaw), tilt)
        self.body.set_base(place, orientation, worlds=worlds)
        joints = rng.uniform(self.low, self.high)
        self.body.set_joints(self.stance + share[:, None] * (joints - self.stance), worlds=worlds)
        place[:, 2] -= self.find_lowest()[worlds]
        self.body.set_base(place, orientation, worlds=worlds)

    def find_lowest(self) -> np.ndarray:
        """Return the height of the lowest point of trunk and legs [m], shape (worlds,)."""
        legs = np.stack([self.body.link_position(part)[:, 2] for part in PARTS], 1) - THICKNESS
        trunk = self.body.base_position[:, None] + rotate(self.body.base_orientation[:, None], CORNERS)
        return np.minimum(legs.min(axis=1), trunk[..., 2].min(axis=1))

    def act(self, action: np.ndarray) -> None:
        """Set the joints' target angles, in the limp time those that joints have."""
        super().act(action)
        limp = self.steps * self.control_dt <= self.limp
        self.body.drive_to(np.where(limp[:, None], self.body.joint_positions, self.stance + self.reach * action))

    def measure(self) -> None:
        """Compute what rewards and success share, once per step."""
        super().measure()
        self.tilt = np.arccos(np.clip(-self.gravity[:, 2], -1.0, 1.0))  # [rad], of the trunk
        self.distance = np.sqrt(rewards.squared(self.body.joint_positions - self.stance))  # [rad], from the stance
        self.speed = np.linalg.norm(self.velocity, axis=1) + 0.2 * np.linalg.norm(self.turning, axis=1)  # [m/s]
        is_up = (self.gravity[:, 2] < -0.95) & (np.abs(self.height - self.target_height) < 0.05)
        self.still = np.where(is_up & (self.distance < 0.2) & (self.speed < CALM), self.still + 1, 0)

    def is_terminated(self) -> np.ndarray:
        """Never: it may fall again, and get up again."""
        self.measure()
        return np.zeros(self.worlds, bool)

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Return how upright, high, near its stance and still it is; while it lies, effort is free and rest costs."""
        up = np.maximum(-self.gravity[:, 2], 0.0) ** 2  # 1 upright, 0 on its side
        return {
            "upright": 1.0 - self.tilt / np.pi,
            "height": up * np.clip(self.height / self.target_height, 0.0, 1.0),
            "stance": up * rewards.closeness(self.distance, 0.5),
            "still": up * rewards.closeness(self.distance, 0.3) * rewards.closeness(self.speed, 0.2),
            "idle": (1.0 - up) * rewards.closeness(self.speed, 0.3),
            "rest": up * rewards.squared(action),
            "smoothness": up * rewards.squared(self.action_change),
            "motion": up * rewards.squared(self.body.joint_velocities),
            "is_up": (self.still > 0).astype(float),
        }

    def is_success(self) -> np.ndarray:
        """It has been standing still for `STILL_S`."""
        return self.still * self.control_dt >= STILL_S
