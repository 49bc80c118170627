"""Reach in many worlds at once: the task of reach.py as a `BatchTask`, for MuJoCo."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rlctl.task import BatchTask, CommandTerm, Joints, Sim, WorldRngs, rewards
from rlctl_manipulation.reach import (
    GAIN,
    GOAL_HIGH,
    GOAL_LOW,
    HAND,
    HOME,
    HOME_NOISE,
    JOINT_STEP,
    MAX_SPEED,
    SPEED_LIMIT,
    Reach,
    check_goals,
)


@dataclass
class ReachBatch(BatchTask):
    """Reach, in many worlds at once: bring the hand within `tolerance` of the goal and keep it there."""

    tolerance: float = 0.05  # [m]
    goal_low: tuple[float, float, float] = GOAL_LOW  # [m], of the box that goals are drawn from
    goal_high: tuple[float, float, float] = GOAL_HIGH  # [m]
    start_noise: float = HOME_NOISE  # [rad], to each side of the home position

    goal: np.ndarray = field(init=False, repr=False)  # [m]
    last_action: np.ndarray = field(init=False, repr=False)
    action_change: np.ndarray = field(init=False, repr=False)

    robot = Reach.robot
    control_dt, substeps, episode_s = Reach.control_dt, Reach.substeps, Reach.episode_s
    solver_iterations = Reach.solver_iterations
    action_space, action_meaning = Reach.action_space, Reach.action_meaning
    observation_units, observation_terms = Reach.observation_units, Reach.observation_terms
    reward_weights, events = Reach.reward_weights, Reach.events
    per_world = {"goal": (3,), "last_action": (7,), "action_change": (7,)}

    def build(self, sim: Sim) -> None:
        """Load the floor and the arm."""
        check_goals(np.array(self.goal_low), np.array(self.goal_high))
        sim.load("plane", "plane.urdf", fixed=True)
        self.arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
        self.arm.cap_joint_speed(SPEED_LIMIT.max())
        self.max_speed, self.max_torque = MAX_SPEED.tolist(), self.arm.joint_max_force.tolist()

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        """Start near the home position, with a goal in a box."""
        self.arm.set_joints(HOME + rng.uniform(-self.start_noise, self.start_noise, 7), worlds=worlds)
        self.goal[worlds] = rng.uniform(self.goal_low, self.goal_high)

    def act(self, action: np.ndarray) -> None:
        """Move every joint's target: the joint's angle plus a step."""
        target = self.arm.joint_positions + JOINT_STEP * action
        target = np.clip(target, self.arm.joint_low, self.arm.joint_high)
        self.arm.drive_to(target, max_speed=self.max_speed, max_force=self.max_torque, gain=GAIN)
        self.action_change = action - self.last_action
        self.last_action = action.astype(float)

    def observe(self) -> dict[str, Any]:
        """Return the arm's state and where the goal is, seen from the hand."""
        hand = self.arm.link_position(HAND)
        return {
            "joint_positions": self.arm.joint_positions,
            "joint_velocities": self.arm.joint_velocities,
            "hand": hand,
            "hand_to_goal": (self.goal, hand),
        }

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Return the distance, how near the goal is, and the size of the action and of its change."""
        distance = self.distance()
        return {
            "distance": distance,
            "reached": rewards.closeness(distance, self.tolerance),
            "action": rewards.squared(action),
            "smoothness": rewards.squared(self.action_change),
        }

    def distance(self) -> np.ndarray:
        """Distances from the hands to the goals [m], shape (worlds,)."""
        return rewards.distance(self.arm.link_position(HAND), self.goal)

    def is_success(self) -> np.ndarray:
        """The hand is within `tolerance` of the goal."""
        return self.distance() < self.tolerance

    def markers(self) -> dict[str, np.ndarray]:
        """The goal."""
        return {"goal": self.goal}

    def commands(self) -> dict[str, CommandTerm]:
        """Return the positions of the goals."""
        rows = zip("xyz", self.goal.T, self.goal_low, self.goal_high, strict=True)
        return {f"goal_{axis}": CommandTerm(values, low, high, "m") for axis, values, low, high in rows}

    def set_commands(self, values: Mapping[str, np.ndarray]) -> None:
        """Move the goals."""
        for name, value in values.items():
            self.goal[:, "xyz".index(name[-1])] = value

    def describe_joints(self) -> Joints:
        """The arm's. Actions are steps from where a joint is, so they have no scale about the home position."""
        return self.arm.describe_joints(
            self.arm.joint_names,
            default_positions=HOME.tolist(),
            action_step=JOINT_STEP.tolist(),
            measured="joint_positions",
            clips_target=True,
        )
