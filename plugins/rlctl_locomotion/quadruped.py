"""Quadruped: Unitree's A1 trots at a commanded speed."""

from dataclasses import dataclass

import numpy as np

from rlctl.task import Box, Event, Joints, Sim, TaskError, events, rewards
from rlctl_locomotion.legged import Legged

LEGS = ("FR", "FL", "RR", "RL")  # front right and so on, as in the model
JOINTS = [f"{leg}_{joint}_joint" for leg in LEGS for joint in ("hip", "upper", "lower")]
FEET = tuple(f"{leg}_toe" for leg in LEGS)
STANCE = np.array([0.0, 0.9, -1.8] * 4)  # [rad]; the model's zero pose is outside its limits
ANGLES = np.array([0.2, 0.4, 0.4] * 4)  # [rad], from the stance, at action 1
GAIN = 0.2  # part of the position error that the motors take away in a physics step
HEIGHT = 0.27  # [m], of the trunk in the stance
UPRIGHT = 0.2  # [m]; the trunk is above it while the robot counts as alive
SPEED_SCALE = 0.25  # [m/s]; so far from the command, tracking is worth 1/e


@dataclass
class Quadruped(Legged):
    """Walk forwards at a commanded speed, drawn in every episode, and stay up."""

    slowest: float = 0.3  # [m/s], of the commanded speeds
    fastest: float = 0.7  # [m/s]
    tolerance: float = 0.1  # [m/s], by which the mean speed of an episode may differ from the commanded one
    episode_s: float = 10.0  # [s], 500 steps

    robot = "Unitree A1"
    control_dt, substeps, solver_iterations = 0.02, 5, 20  # [s], -, -
    action_space = Box(-1.0, 1.0, (12,), np.float32)
    action_meaning = "joint angles from the stance; 1 is 0.2 rad of a hip, 0.4 rad of an upper or a lower leg"
    observation_units = {
        "joint_positions": "rad",
        "joint_velocities": "rad/s",
        "height": "m",
        "attitude": "rad",
        "velocity": "m/s",
        "angular_velocity": "rad/s",
        "command": "m/s",
    }
    # Document A pays 1 for being alive, as much as for walking at 1 m/s; here it is the tracking that pays.
    reward_weights = {
        "tracking": 1.0,
        "forward": 0.5,
        "alive": 0.2,
        "fall": -5.0,
        "action": -0.12,  # of the mean square: -0.01 of the sum over 12 joints
        "posture": -0.1,
        "heading": -0.2,
        "smoothness": -2.0,  # with -0.05 it shuffled, ten steps a second, with -0.5 it hopped, seven
    }
    events = {  # with `randomize: true`
        "mass": Event("reset", events.scale_mass, body="robot", factor=(0.8, 1.2)),
        "friction": Event("reset", events.set_friction, body="ground", friction=(0.3, 1.5)),
        "contact_stiffness": Event(
            "reset", events.set_contact_stiffness, body="ground", stiffness=(1.5e3, 1e5)
        ),  # [N/m]
        "gravity": Event("reset", events.shift_gravity, change=(-0.5, 0.5)),  # [m/s^2]
        "joint_damping": Event("reset", events.set_joint_damping, body="robot", damping=(0.0, 0.2)),  # [N m s/rad]
        "motor_strength": Event("reset", events.scale_motor_strength, body="robot", factor=(0.8, 1.0)),
        "color": Event("reset", events.set_color, body="robot", red=(0, 1), green=(0, 1), blue=(0, 1)),
        "start": Event("start", events.offset_joints, body="robot", velocity=(-0.5, 0.5)),  # [rad/s]
        "position_noise": Event("observation", events.noise, of="joint_positions", std=(0.0, 0.01)),  # [rad]
        "velocity_noise": Event("observation", events.noise, of="joint_velocities", std=(0.0, 0.2)),  # [rad/s]
        "attitude_noise": Event("observation", events.noise, of="attitude", std=(0.0, 0.02)),  # [rad]
        "observation_delay": Event("observation", events.delay, steps=(0, 1)),  # of 20 ms
        "action_noise": Event("action", events.noise, std=(0.0, 0.05)),
        "action_delay": Event("action", events.delay, steps=(0, 1)),
        "push": Event("interval", events.push, every_s=3.0, body="robot", force=(0.0, 40.0), duration_s=(0.1, 0.2)),
    }
    feet, fallen_height = FEET, 0.15
    highest_step = 0.08  # a third of the trunk's height
    rlctl_ignore = {"RL611": "walking at a speed is what training is for; random actions stay where they are"}

    def build(self, sim: Sim) -> None:
        """Load the ground and the robot."""
        if not 0 <= self.slowest <= self.fastest:
            raise TaskError(f"slowest {self.slowest:g}, fastest {self.fastest:g} m/s: give 0 <= slowest <= fastest")
        self.build_ground(sim)
        self.body = sim.load("robot", "a1.urdf", position=(0.0, 0.0, HEIGHT))
        self.body.set_friction(1.0)  # times the ground's
        self.joints = self.body.find_joints(JOINTS)  # of all, in the model's order
        self.low, self.high = self.body.joint_low[self.joints], self.body.joint_high[self.joints]

    def reset(self, rng: np.random.Generator) -> None:
        """Stand still, and get a commanded speed."""
        self.body.set_base((0.0, 0.0, HEIGHT + 0.01))  # 1 cm above the ground, so that no foot starts in it
        self.body.set_joints(self.draw_pose(rng, STANCE))
        self.command = rng.uniform(self.slowest, self.fastest)
        self.steps = 0
        self.begin(12)

    def act(self, action: np.ndarray) -> None:
        """Set the joints' target angles."""
        target = np.minimum(np.maximum(STANCE + ANGLES * action, self.low), self.high)
        self.body.drive_to(target, gain=GAIN)
        self.note_action(action)
        self.steps += 1

    def observe(self) -> dict[str, np.ndarray]:
        """Return the state of joints and trunk, which feet touch the ground, and the speed to walk at."""
        return {
            "joint_positions": self.body.joint_positions,
            "joint_velocities": self.body.joint_velocities,
            "height": np.array([self.trunk.position[2]]),
            "attitude": np.array(self.attitude),
            "velocity": np.array(self.trunk.velocity),
            "angular_velocity": np.array(self.trunk.angular_velocity),
            "foot_contacts": self.foot_contacts,
            "command": np.array([self.command]),
            "last_action": self.last_action,
        }

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        """Return how well the speed is kept, and document A's terms."""
        speed = self.trunk.velocity[0]
        roll, pitch, yaw = self.attitude
        return {
            "tracking": rewards.closeness(speed - self.command, SPEED_SCALE),
            "forward": min(speed, self.command),  # faster earns no more
            "alive": float(self.trunk.position[2] > UPRIGHT),
            "fall": float(self.is_fallen()),
            "action": rewards.squared(action),
            "posture": roll**2 + pitch**2,
            "heading": yaw**2,
            "smoothness": rewards.squared(self.action_change),
        }

    def is_success(self) -> bool:
        """It has walked at the commanded speed, on average within `tolerance`, and is up."""
        mean_speed = self.trunk.position[0] / max(self.steps * self.control_dt, self.control_dt)
        return not self.is_fallen() and abs(mean_speed - self.command) <= self.tolerance

    def describe_joints(self) -> Joints:
        """The legs', leg by leg."""
        return self.body.describe_joints(JOINTS, default_positions=STANCE.tolist(), action_scale=ANGLES.tolist())
