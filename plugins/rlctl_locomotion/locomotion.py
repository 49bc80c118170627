"""What the five robots share: torques in, running towards a far target, the family's observations and rewards.

These are the tasks of `AntBulletEnv-v0` and its family as pybullet-envs-gymnasium 0.6.0 has them from an instance's
second episode on, which is what training sees. (In the first one the floor joins the mean of the body parts' positions
only after the reset, and step 1 is rewarded for the jump.) Comments say where their behaviour is odd: published scores
depend on it, so it stays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from rlctl.task import Event, Joints, Sim, Task, events

MODELS = Path(__file__).parent / "models" / "mujoco"
TARGET_X, TARGET_Y = 1000.0, 0.0  # [m], world frame: a direction rather than a place
START_NOISE = 0.1  # [rad]
AT_LIMIT = float(np.float32(0.99))  # of the way from the middle of a joint's range to its end, rounded as angles are
OBSERVED = 5.0  # what is observed is cut off beyond it


@dataclass
class Locomotion(Task):
    """Run towards +x and stay on your feet. A robot fills in its model, feet and motors, and says when it stands."""

    model: ClassVar[str]
    """MJCF file in `pybullet_data`, and in `MODELS` for MuJoCo; one of its links, or the base, is called `torso`."""
    feet: ClassVar[tuple[str, ...]]
    """Links whose contact with the floor is observed."""
    motors: ClassVar[Mapping[str, float]]
    """Torque at action 1 [N m] of each joint, in the order of actions and observations, which is the model's."""
    torque_type: ClassVar[type[np.floating[Any]]] = np.float64
    alive_bonus: ClassVar[float] = 1.0
    power_weight, torque_weight = 2.0, 0.1
    """Of the mean |action * joint speed / 10|, and of the mean squared action."""

    episode_s: float = 16.5  # [s]
    control_dt, substeps = 0.0165, 4  # [s], -
    solver_iterations = 5
    action_meaning = "joint torques; 1 is a motor's top torque"
    observation_units = {"height": "m", "roll_pitch": "rad"}
    # feet_collision, the feet that touch the robot itself: the family has it and leaves it out of the sum.
    reward_weights = {
        "alive": 1.0,
        "progress": 1.0,
        "electricity": -1.0,
        "joints_at_limit": -0.1,
        "feet_collision": 0.0,
    }
    events = {  # with `randomize: true`; without, the tasks are the family's
        "mass": Event("reset", events.scale_mass, body="robot", factor=(0.8, 1.2)),
        "friction": Event("reset", events.set_friction, body="floor", friction=(0.3, 1.5)),
        "gravity": Event("reset", events.shift_gravity, change=(-0.5, 0.5)),  # [m/s^2]
        "color": Event("reset", events.set_color, body="robot", red=(0, 1), green=(0, 1), blue=(0, 1)),
        "motor_strength": Event("reset", events.scale_motor_strength, body="robot", factor=(0.8, 1.0)),
        "start": Event("start", events.offset_joints, body="robot", velocity=(-0.1, 0.1)),  # [rad/s]
        "joint_noise": Event("observation", events.noise, of="joints", std=(0.0, 0.02)),
        "observation_delay": Event("observation", events.delay, steps=(0, 1)),  # of 16.5 ms
        "action_noise": Event("action", events.noise, std=(0.0, 0.05)),
        "action_delay": Event("action", events.delay, steps=(0, 1)),  # of 16.5 ms
    }
    rlctl_ignore = {"RL609": "the family counts returns; how far to run is nowhere said"}

    def stands(self, height: float, pitch: float) -> bool:
        """Say whether the robot is up, from the height [m] and pitch [rad] of its torso."""
        raise NotImplementedError

    def build(self, sim: Sim) -> None:
        """Load the floor and the robot, its motors switched off."""
        sim.set_gravity(9.8)
        sim.set_contact_erp(0.9)
        is_bullet = sim.engine == "PyBullet"  # MuJoCo reads no SDF, and reads these MJCF files differently
        self.floor = sim.load("floor", "plane_stadium.sdf" if is_bullet else "plane.urdf")
        self.floor.set_friction(0.8)  # and no restitution: theirs is multiplied with the robot's, which is 0
        self.body = sim.load("robot", f"mjcf/{self.model}" if is_bullet else MODELS / self.model, self_collision=True)
        self.body.disable_motors()
        for link in ("torso", *self.feet):
            self.body.mass_state(link)  # raises for one that the model does not have
        joints = self.body.find_joints(self.motors)
        if joints != list(range(joints[0], joints[0] + len(joints))):
            raise ValueError(f"{self.model}: name the motors one after the other, as the model has them")
        self.joints = slice(joints[0], joints[0] + len(joints))  # twice as fast as a list
        self.top_torques = np.array(list(self.motors.values()), self.torque_type)
        low = self.body.joint_low[self.joints]
        self.joint_low, self.joint_range = low.tolist(), (self.body.joint_high[self.joints] - low).tolist()
        self.torques = np.zeros(len(self.body.joint_names))
        self.links = [link for link in self.body.link_names if link != "torso"]
        self.observed_high = np.full((2, len(self.motors)), OBSERVED, np.float32)  # faster than a plain number
        self.observed_low = -self.observed_high

    def reset(self, rng: np.random.Generator) -> None:
        """Start every motor's joint within 0.1 rad of 0."""
        positions = self.body.joint_positions.copy()
        positions[self.joints] = rng.uniform(-START_NOISE, START_NOISE, len(self.motors))
        self.body.set_joints(positions)
        self.start_height = self.body.mass_state("torso").position[2]
        self.feet_contact = self.last_feet_contact = np.zeros(len(self.feet), np.float32)
        self.update()

    def update(self) -> None:
        """Compute what both rewards and observations need, once per step."""
        first, *others = self.body.mass_positions(self.links)
        # In the family's order: the last bit of a mean depends on it.
        xs, ys, _ = zip(first, self.body.mass_state("torso").position, *others, strict=True)
        x, y = np.add.reduce((xs, ys), 1) / (len(xs) + 1)  # the family's mean has the floor, at 0, among the parts
        self.to_target = np.array([TARGET_Y - y, TARGET_X - x])  # [m]
        # Plain floats, which are faster than arrays of so few; angles are -1 and 1 at the limits.
        positions, speeds = self.body.joint_positions[self.joints], self.body.joint_velocities[self.joints]
        ranges = zip(positions.tolist(), self.joint_low, self.joint_range, strict=True)
        angles = [2 * (position - low) / between - 1 for position, low, between in ranges]
        self.joint_states = np.array((angles, [0.1 * speed for speed in speeds.tolist()]), np.float32)

    def potential(self) -> float:
        """Minus the time [s] to the target at 1 m per control step; its change is the speed [m/s] towards it."""
        return -math.sqrt(self.to_target.dot(self.to_target)) / self.control_dt

    def act(self, action: np.ndarray) -> None:
        """Apply a torque to every motor's joint: 1 is its top torque."""
        # Contacts are observed, and by the half-cheetah judged, one step late.
        self.last_feet_contact = self.feet_contact
        self.last_potential = self.potential()
        self.torques[self.joints] = self.top_torques * action
        self.body.set_torques(self.torques)

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        """Return the family's terms."""
        self.update()
        touching = self.body.links_touching(self.floor)
        self.feet_contact = np.array([foot in touching for foot in self.feet], np.float32)
        power = np.add.reduce(np.abs(action * self.joint_states[1])) / action.size
        torque = np.add.reduce(np.square(action)) / action.size
        return {
            "alive": self.alive(),
            "progress": self.potential() - self.last_potential,
            "electricity": self.power_weight * float(power) + self.torque_weight * float(torque),
            "joints_at_limit": float(sum(abs(angle) > AT_LIMIT for angle in self.joint_states[0].tolist())),
            "feet_collision": float(len(self.body.links_touching(self.body).intersection(self.feet))),
        }

    def alive(self) -> float:
        """The bonus while the robot stands, -1 when it does not."""
        torso = self.body.mass_state("torso")
        return self.alive_bonus if self.stands(torso.position[2], torso.roll_pitch_yaw[1]) else -1.0

    def is_terminated(self) -> bool:
        """End the episode when the robot does not stand."""
        return self.alive() < 0

    def observe(self) -> dict[str, np.ndarray]:
        """Return what the family observes."""
        torso = self.body.mass_state("torso")
        roll, pitch, yaw = torso.roll_pitch_yaw
        heading = math.atan2(*self.to_target) - yaw
        (vx, vy, vz), sin, cos = torso.velocity, math.sin(yaw), math.cos(yaw)
        forward = (cos * vx + sin * vy, cos * vy - sin * vx, vz)  # [m/s], in the direction that the torso faces
        return {
            "height": np.array([cut_off(torso.position[2] - self.start_height)]),
            "heading": np.array([math.sin(heading), math.cos(heading)]),
            "velocity": np.array([cut_off(0.3 * speed) for speed in forward]),
            "roll_pitch": np.array([roll, pitch]),
            "joints": np.minimum(np.maximum(self.joint_states, self.observed_low), self.observed_high).T,
            "feet_contact": self.last_feet_contact,
        }

    def describe_joints(self) -> Joints:
        """Those with a motor; actions are torques."""
        return self.body.describe_joints(list(self.motors))


def cut_off(value: float) -> float:
    """Return `value`, or the end of the observed range that it is beyond."""
    return min(max(value, -OBSERVED), OBSERVED)
