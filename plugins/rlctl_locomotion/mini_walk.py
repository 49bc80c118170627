"""Mini walk: a robot of 1.55 kg with 14 hobby servos follows velocity commands, stepping in time with a clock."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from rlctl.task import Box, Event, Sim, events, rewards, terms
from rlctl.task.rotations import rotate_inverse
from rlctl_locomotion.clocked import Clocked
from rlctl_locomotion.humanoid_walk import FEET, LEG

JOINTS = [f"{side}_{joint}" for side in ("left", "right") for joint in LEG] + ["neck_pitch", "head_yaw"]
STANCE = np.array([0.0, 0.0, -0.4, 0.8, -0.4, 0.0] * 2 + [0.0, 0.0])  # [rad]
KEPT = np.array([name.endswith(("yaw", "hip_roll", "neck_pitch")) for name in JOINTS])
OTHER_SIDE = (-7, -8, 9, 10, 11, -12, -1, -2, 3, 4, 5, -6, 13, -14)  # yaw and roll turn the other way
OTHER_MOTOR = tuple(map(abs, OTHER_SIDE))
SOLE = 0.03  # [m], from an ankle to the ground


def widen(nominal: float, low: float, high: float) -> dict[str, tuple[float, float]]:
    """Return a range that grows from the nominal value: with full ranges from the start it stepped on the spot."""
    return {"from": (nominal, nominal), "to": (low, high)}


@dataclass
class MiniWalk(Clocked):
    """Walk forwards, sideways and turn as commanded, without falling; linear velocity is not observed."""

    tolerance: float = 0.15  # [m/s], largest mean error of the velocity in an episode that succeeds
    start_noise: float = 0.05  # [rad], of every joint, to each side of the stance

    robot = "robot of 1.55 kg with hobby servos"
    model: ClassVar[Path] = Path(__file__).with_name("models") / "mini_walk.xml"
    joint_order: ClassVar[list[str]] = JOINTS
    self_collision: ClassVar[bool] = True
    stance: ClassVar[np.ndarray] = STANCE
    period_s: ClassVar[float] = 0.45
    swing: ClassVar[float] = 0.025
    first_half: ClassVar[tuple[float, float]] = (1.0, -1.0)
    start_height: ClassVar[float] = 0.295
    target_height: ClassVar[float] = 0.285
    fallen_height: ClassVar[float] = 0.2
    lowest: ClassVar[np.ndarray] = np.array([-0.4, -0.15, -0.8])
    highest: ClassVar[np.ndarray] = np.array([0.4, 0.15, 0.8])
    scale = 0.3  # [m/s]; so far from the command, tracking is worth 1/e
    turn_scale = 1.0  # [rad/s], likewise; a light trunk above heavy legs twists at each step

    action_space = Box(-4.0, 4.0, (14,), np.float32)
    observation_terms = {
        **Clocked.observation_terms,
        "joint_positions": terms.Scaled("joint_positions", offset=tuple(STANCE)),
    }
    reward_weights = {
        **Clocked.reward_weights,
        "tracking": 0.3,
        "turning": 0.15,
        "gait": 0.3,
        "pose": -0.3,
        "height": -4.0,
    }
    per_world = {**Clocked.per_world, "last_action": (14,), "action_change": (14,)}
    mirror = {
        **Clocked.mirror,
        **dict.fromkeys(("joint_positions", "joint_velocities", "last_action", "action"), OTHER_SIDE),
        "velocity": (1, -2, 3),
        "height": (1,),
        "foot_heights": (2, 1),
        "events/push": (1, -2),  # speed and direction
        "events/motor_bias": OTHER_SIDE,
        "events/torque_constant": OTHER_MOTOR,
        "events/motor_friction": OTHER_MOTOR,
    }
    events = {
        "mass": Event("reset", events.scale_mass, body="robot", factor=widen(1.0, 0.8, 1.2)),
        "friction": Event("reset", events.set_friction, body="ground", friction=widen(0.8, 0.4, 1.2)),
        "voltage": Event("reset", events.voltage, body="robot", voltage_v=widen(7.4, 6.4, 8.4)),  # of two lithium cells
        "torque_constant": Event("reset", events.torque_constant, body="robot", factor=widen(1.0, 0.9, 1.1)),
        "motor_friction": Event("reset", events.motor_friction, body="robot", coulomb_nm=widen(0.05, 0.02, 0.1)),
        "motor_bias": Event("reset", events.motor_bias, body="robot", bias_rad=widen(0.0, -0.03, 0.03)),
        "gyroscope_noise": Event("observation", events.noise, of="gyroscope", std=widen(0.0, 0.0, 0.2)),  # [rad/s]
        "position_noise": Event("observation", events.noise, of="joint_positions", std=widen(0.0, 0.0, 0.01)),  # [rad]
        "velocity_noise": Event(
            "observation", events.noise, of="joint_velocities", std=widen(0.0, 0.0, 0.5)
        ),  # [rad/s]
        "action_delay": Event("action", events.delay, steps=widen(0, 0, 1)),  # of one action
        "push": Event("interval", events.kick, every_s=4.0, body="robot", speed=widen(0.0, 0.0, 0.3)),  # [m/s]
    }

    def build(self, sim: Sim) -> None:
        """Load the ground and the robot, whose joints have servos, not the springs of the family."""
        super().build(sim)
        self.body.set_motors("sts3215")

    def measure_feet(self) -> np.ndarray:
        """Return the heights of the soles above the ground [m], left and right, shape (worlds, 2)."""
        return np.stack([self.body.link_position(foot)[:, 2] - SOLE for foot in FEET], axis=1)

    def privileged(self) -> dict[str, np.ndarray]:
        """Return the velocity and the heights of trunk and feet."""
        velocity = rotate_inverse(self.body.base_orientation, self.body.base_velocity)
        return {"velocity": velocity, "height": self.measure_height()[:, None], "foot_heights": self.measure_feet()}

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Return what `Clocked` does, with a scale of its own for turning, and how far it is bent from the stance."""
        bent = np.compress(KEPT, self.body.joint_positions - self.stance, axis=1)
        turning = rewards.closeness(self.command[:, 2] - self.turning[:, 2], self.turn_scale)
        return {**super().rewards(action), "turning": turning, "pose": rewards.squared(bent)}
