"""Reach: a KUKA LBR iiwa brings its hand to a goal."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rlctl.task import Box, CommandTerm, Event, Joints, Sim, Task, TaskError, events, rewards, terms

HOME = np.array([0.0, 0.5, 0.0, -1.2, 0.0, 0.9, 0.0])  # [rad], elbow bent
SPEED_LIMIT = np.radians([85, 85, 100, 75, 130, 135, 135])  # [rad/s], LBR iiwa 14 R820 data sheet
MAX_SPEED = 0.75 * SPEED_LIMIT  # of the motors: moving joints push each other beyond it, by up to a third
GOAL_LOW, GOAL_HIGH = (0.45, -0.3, 0.2), (0.7, 0.3, 0.6)  # [m], world frame, in front of the arm
JOINT_STEP = 1.5 * MAX_SPEED * 4 / 240  # [rad], further than a control step gets: a full action is full speed
GAIN = 0.25  # part of the position error that the motors take away in a physics step
HOME_NOISE = 0.1  # [rad]
HAND = "lbr_iiwa_link_7"
SHOULDER, ARM_LENGTH = np.array([0.0, 0.0, 0.36]), 0.88  # [m]; stretched, it is 0.9 m from the shoulder to the hand


@dataclass
class Reach(Task):
    """Bring the hand within `tolerance` of the goal and keep it there until the episode ends."""

    tolerance: float = 0.05  # [m]
    goal_low: tuple[float, float, float] = GOAL_LOW  # [m], of the box that goals are drawn from
    goal_high: tuple[float, float, float] = GOAL_HIGH  # [m]
    start_noise: float = HOME_NOISE  # [rad], to each side of the home position

    robot = "KUKA LBR iiwa"
    control_dt, substeps, episode_s = 4 / 240, 4, 2.0  # [s], -, [s]
    solver_iterations = 10  # after 2 s without feedback the hand is 6 mm (median) from where 500 would bring it
    action_space = Box(-1.0, 1.0, (7,), np.float32)
    action_meaning = "joint steps; 1 moves a joint at its top speed"
    observation_units = {
        "joint_positions": "rad",
        "joint_velocities": "rad/s",
        "hand": "m",
        "hand_to_goal": "m",
        "goal": "m",
    }
    observation_terms = {"hand_to_goal": terms.Displacement("goal", "hand")}
    reward_weights = {"distance": -1.0, "reached": 1.0, "action": -0.05, "smoothness": -0.05}
    events = {  # what a real arm may differ by; acts with `randomize: true`
        "mass": Event("reset", events.scale_mass, body="arm", factor=(0.8, 1.2)),
        "gravity": Event("reset", events.shift_gravity, change=(-0.5, 0.5)),  # [m/s^2]
        "color": Event("reset", events.set_color, body="arm", red=(0, 1), green=(0, 1), blue=(0, 1)),
        "joint_damping": Event("reset", events.scale_joint_damping, body="arm", factor=(0.5, 1.5)),
        "motor_strength": Event("reset", events.scale_motor_strength, body="arm", factor=(0.8, 1.0)),
        "position_noise": Event("observation", events.noise, of="joint_positions", std=(0.0, 0.002)),  # [rad]
        "velocity_noise": Event("observation", events.noise, of="joint_velocities", std=(0.0, 0.05)),  # [rad/s]
        "goal_noise": Event("observation", events.noise, of="hand_to_goal", std=(0.0, 0.005)),  # [m], of a camera
        "start": Event("start", events.offset_joints, body="arm", velocity=(-0.2, 0.2)),  # [rad/s]
        "observation_delay": Event("observation", events.delay, steps=(0, 1)),  # of 17 ms
        "action_noise": Event("action", events.noise, std=(0.0, 0.05)),
        "action_delay": Event("action", events.delay, steps=(0, 2)),  # of 17 ms
    }

    def build(self, sim: Sim) -> None:
        """Load the floor and the arm."""
        check_goals(np.array(self.goal_low), np.array(self.goal_high))
        sim.load("plane", "plane.urdf", fixed=True)
        self.arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
        self.arm.cap_joint_speed(SPEED_LIMIT.max())  # a blow on the floor would turn joints faster than any motor
        self.max_speed, self.max_torque = MAX_SPEED.tolist(), self.arm.joint_max_force.tolist()

    def reset(self, rng: np.random.Generator) -> None:
        """Start near the home position, with a goal in a box."""
        self.arm.set_joints(HOME + rng.uniform(-self.start_noise, self.start_noise, 7))
        self.goal = rng.uniform(self.goal_low, self.goal_high)
        self.last_action = self.action_change = np.zeros(7, np.float32)

    def act(self, action: np.ndarray) -> None:
        """Move every joint's target: the joint's angle plus a step."""
        target = self.arm.joint_positions + JOINT_STEP * action
        target = np.minimum(np.maximum(target, self.arm.joint_low), self.arm.joint_high)
        self.arm.drive_to(target, max_speed=self.max_speed, max_force=self.max_torque, gain=GAIN)
        self.action_change, self.last_action = action - self.last_action, action

    def observe(self) -> dict[str, Any]:
        """Return the arm's state and where the goal is, seen from the hand."""
        hand = self.arm.link_position(HAND)
        return {
            "joint_positions": self.arm.joint_positions,
            "joint_velocities": self.arm.joint_velocities,
            "hand": hand,
            "hand_to_goal": (self.goal, hand),
        }

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        """Return the distance, how near the goal is, and the size of the action and of its change."""
        distance = self.distance()
        return {
            "distance": distance,
            "reached": rewards.closeness(distance, self.tolerance),
            "action": rewards.squared(action),
            "smoothness": rewards.squared(self.action_change),
        }

    def distance(self) -> float:
        """Distance from the hand to the goal [m]."""
        return rewards.distance(self.arm.link_position(HAND), self.goal)

    def is_success(self) -> bool:
        """The hand is within `tolerance` of the goal."""
        return self.distance() < self.tolerance

    def markers(self) -> dict[str, np.ndarray]:
        """The goal."""
        return {"goal": self.goal}

    def commands(self) -> dict[str, CommandTerm]:
        """Return the position of the goal."""
        rows = zip("xyz", self.goal.tolist(), self.goal_low, self.goal_high, strict=True)
        return {f"goal_{axis}": CommandTerm(value, low, high, "m") for axis, value, low, high in rows}

    def set_commands(self, values: Mapping[str, float]) -> None:
        """Move the goal."""
        for name, value in values.items():
            self.goal["xyz".index(name[-1])] = value

    def describe_joints(self) -> Joints:
        """The arm's. Actions are steps from where a joint is, so they have no scale about the home position."""
        return self.arm.describe_joints(
            self.arm.joint_names,
            default_positions=HOME.tolist(),
            action_step=JOINT_STEP.tolist(),
            measured="joint_positions",
            clips_target=True,
        )


def check_goals(low: np.ndarray, high: np.ndarray) -> None:
    """Raise `TaskError` for a box of goals from `low` to `high` [m] that is empty, under the floor or out of reach."""
    if not (low <= high).all() or low[2] < 0:
        raise TaskError(f"goal_low {low.tolist()}, goal_high {high.tolist()}: give low <= high, above the floor")
    furthest = float(np.linalg.norm(np.maximum(abs(low - SHOULDER), abs(high - SHOULDER))))
    if furthest > ARM_LENGTH:
        raise TaskError(
            f"goal_low, goal_high: a corner of the box is {furthest:.2f} m from the shoulder, and the arm gets to "
            f"{ARM_LENGTH:g} m. Use a smaller box."
        )
