"""Biped: two hips and two knees learn to walk, on a rail (`biped`) and free (`biped-3d`)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rlctl.task import Box, Event, Joints, Sim, TaskError, events, rewards
from rlctl_locomotion.legged import Legged

MODELS = Path(__file__).parent / "models"
JOINTS = ["left_hip", "left_knee", "right_hip", "right_knee"]
RAIL = ["rail_x", "rail_z", "pitch"]
ANGLE = 0.5  # [rad], of a joint at action 1
FORCE = [50.0] * 4  # [N m], of a motor
GAIN = 0.2  # part of the position error that the motors take away in a physics step
HEIGHT = 0.58  # [m], of the trunk's middle, standing with straight legs
STANCE = np.array([0.25, 0.0, -0.25, 0.0])  # [rad], one leg before the other: with straight legs nothing could stand


@dataclass
class Biped(Legged):
    """Walk forwards on a rail, in a vertical plane: at least `least_distance` in an episode, without a fall."""

    least_distance: float = 5.0  # [m]; 0 asks only to stand
    top_speed: float = 1.0  # [m/s], what is faster earns no more
    episode_s: float = 20.0  # [s], 1,000 steps

    robot = "biped, four joints"
    control_dt, substeps, solver_iterations = 0.02, 4, 20  # [s], -, -
    action_space = Box(-1.0, 1.0, (4,), np.float32)
    action_meaning = "joint angles of left hip, left knee, right hip, right knee; 1 is 0.5 rad forwards"
    observation_units = {
        "joint_positions": "rad",
        "joint_velocities": "rad/s",
        "height": "m",
        "attitude": "rad",
        "velocity": "m/s",
        "angular_velocity": "rad/s",
    }
    # A step at 0.5 m/s earns 1.05 and one on the spot 0.05: with 0.2 and 0.7 all that was learned was to stand.
    # Half a second of diving forwards, which a fall at -5 and a posture at -0.5 paid for, does not pay.
    reward_weights = {
        "progress": 1.0,
        "forward_while_alive": 1.0,
        "alive": 0.05,
        "fall": -15.0,
        "posture": -2.0,
        "energy": -0.0005,
        "smoothness": -0.2,
    }
    events = {  # with `randomize: true`, but for the push, which a recipe or a stage names
        "mass": Event("reset", events.scale_mass, body="robot", factor=(0.8, 1.2)),
        "friction": Event("reset", events.set_friction, body="ground", friction=(0.3, 1.5)),
        "gravity": Event("reset", events.shift_gravity, change=(-0.5, 0.5)),  # [m/s^2]
        "joint_damping": Event("reset", events.scale_joint_damping, body="robot", joints=JOINTS, factor=(0.5, 1.5)),
        "motor_strength": Event("reset", events.scale_motor_strength, body="robot", joints=JOINTS, factor=(0.8, 1.0)),
        "color": Event("reset", events.set_color, body="robot", red=(0, 1), green=(0, 1), blue=(0, 1)),
        "start": Event("start", events.offset_joints, body="robot", joints=JOINTS, velocity=(-0.5, 0.5)),  # [rad/s]
        "position_noise": Event("observation", events.noise, of="joint_positions", std=(0.0, 0.01)),  # [rad]
        "velocity_noise": Event("observation", events.noise, of="joint_velocities", std=(0.0, 0.2)),  # [rad/s]
        "observation_delay": Event("observation", events.delay, steps=(0, 1)),  # of 20 ms
        "action_noise": Event("action", events.noise, std=(0.0, 0.05)),
        "action_delay": Event("action", events.delay, steps=(0, 1)),
        "push": Event(
            "interval", events.push, every_s=3.0, body="robot", link="trunk", force=(0.0, 20.0), duration_s=(0.1, 0.2)
        ),
    }

    rlctl_ignore = {"RL611": "walking metres is what training is for; random actions fall in a second"}
    feet, fallen_height = ("left_foot", "right_foot"), 0.2
    highest_step = 0.1  # a quarter of a leg
    ground_width = 2.4

    def load_robot(self, sim: Sim) -> None:
        """Load the robot as body `robot`, where the ground is at height 0."""
        self.body = sim.load("robot", MODELS / "biped_planar.urdf", fixed=True)
        self.body.disable_motors(RAIL)

    def place(self, height: float, joints: np.ndarray) -> None:
        """Put the robot at the start, its trunk at `height` [m] and its joints, shape (4,), at angles [rad]."""
        self.body.set_joints(np.concatenate([[0.0, height, 0.0], joints]))

    def build(self, sim: Sim) -> None:
        """Load the ground and the robot."""
        if self.least_distance > self.top_speed * self.episode_s:
            raise TaskError(
                f"least_distance: {self.least_distance:g} m is out of reach: at top_speed {self.top_speed:g} m/s an "
                f"episode of {self.episode_s:g} s is {self.top_speed * self.episode_s:g} m long."
            )
        self.build_ground(sim)
        self.load_robot(sim)
        self.body.set_friction(1.0)  # times the ground's
        first, *_, last = self.body.find_joints(JOINTS)
        self.joints = slice(first, last + 1)  # a view of joint arrays, where a list would copy

    def reset(self, rng: np.random.Generator) -> None:
        """Stand still, one leg before the other."""
        joints = self.draw_pose(rng, STANCE)
        # Both feet above the ground by up to 1 cm: a leg of 0.4 m at angle a, its knee bent by b, is so high.
        reach = [0.2 * np.cos(hip) + 0.2 * np.cos(hip + knee) for hip, knee in joints.reshape(2, 2)]
        self.place(HEIGHT - 0.4 + max(reach) + 0.002, joints)
        self.begin(4)

    def act(self, action: np.ndarray) -> None:
        """Set the joints' target angles."""
        self.body.drive_to(ANGLE * action, max_force=FORCE, gain=GAIN, joints=JOINTS)
        self.note_action(action)

    def observe(self) -> dict[str, np.ndarray]:
        """Return the state of joints and trunk, in the plane, and which feet touch the ground."""
        (vx, _, vz), (_, pitch_rate, _) = self.trunk.velocity, self.trunk.angular_velocity
        return {
            **self.observe_legs(),
            "attitude": np.array([self.attitude[1]]),  # [rad], pitch
            "velocity": np.array([vx, vz]),
            "angular_velocity": np.array([pitch_rate]),
        }

    def observe_legs(self) -> dict[str, np.ndarray]:
        """Return joints, height, contacts and the last action, which smoothness is judged by."""
        return {
            "joint_positions": self.body.joint_positions[self.joints],
            "joint_velocities": self.body.joint_velocities[self.joints],
            "height": np.array([self.trunk.position[2]]),
            "foot_contacts": self.foot_contacts,
            "last_action": self.last_action,
        }

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        """Return how fast and how well it walks; `fall` is 1 in the step that ends an episode."""
        fallen = self.is_fallen()
        roll, pitch, _ = self.attitude
        speed = min(self.trunk.velocity[0], self.top_speed)
        return {
            "progress": speed,
            "forward_while_alive": 0.0 if fallen else speed,
            "alive": rewards.alive(fallen),
            "fall": float(fallen),
            "posture": roll**2 + pitch**2,
            "energy": rewards.power(self.body.joint_torques[self.joints], self.body.joint_velocities[self.joints]),
            "smoothness": rewards.squared(self.action_change),
        }

    def is_success(self) -> bool:
        """It has walked far enough, or was only asked to stand, and is up."""
        return not self.is_fallen() and (self.least_distance == 0 or self.trunk.position[0] >= self.least_distance)

    def describe_joints(self) -> Joints:
        """The legs', whose angles are measured from straight legs."""
        return self.body.describe_joints(JOINTS, default_positions=[0.0] * 4, action_scale=[ANGLE] * 4)


@dataclass
class Biped3D(Biped):
    """Walk forwards without a rail: nothing but its feet keeps the robot from falling sideways or turning."""

    top_speed: float = 0.6  # [m/s]; less than on the rail, so that it need not hurry

    robot = "biped, four joints, free"
    reward_weights = {**Biped.reward_weights, "heading": -0.5}
    ground_width = 12.0

    def load_robot(self, sim: Sim) -> None:
        """Load the free robot."""
        self.body = sim.load("robot", MODELS / "biped_3d.urdf", position=(0, 0, HEIGHT))
        self.body.cap_joint_speed(20.0)  # [rad/s, m/s]; a motor's limit is 12, a fall's end 3

    def place(self, height: float, joints: np.ndarray) -> None:
        """Put the robot at the start."""
        self.body.set_base((0.0, 0.0, height))
        self.body.set_joints(joints)

    def observe(self) -> dict[str, np.ndarray]:
        """Return the state of joints and trunk, and which feet touch the ground."""
        return {
            **self.observe_legs(),
            "attitude": np.array(self.attitude),  # [rad], roll, pitch and yaw
            "velocity": np.array(self.trunk.velocity),
            "angular_velocity": np.array(self.trunk.angular_velocity),
        }

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        """Return what the biped on a rail gets, and how far the robot has turned [rad^2]."""
        return {**super().rewards(action), "heading": self.attitude[2] ** 2}
