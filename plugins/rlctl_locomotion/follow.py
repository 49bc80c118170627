"""Follow: robots that follow a clip from any frame to its end; a bow with a squat of the humanoid, a bow of the A1."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from rlctl.task import Box, Event, Joints, Sim, WorldRngs, events, rewards, terms
from rlctl.task.motion import read_motion
from rlctl.task.reference import Reference
from rlctl.task.rotations import rotate_inverse
from rlctl_locomotion.driven import OTHER_SIDE, Driven
from rlctl_locomotion.humanoid_walk import FEET as HUMANOID_FEET
from rlctl_locomotion.humanoid_walk import JOINTS as HUMANOID_JOINTS
from rlctl_locomotion.humanoid_walk import OTHER_SIDE as HUMANOID_OTHER_SIDE
from rlctl_locomotion.humanoid_walk import HumanoidWalk
from rlctl_locomotion.quadruped import FEET as QUADRUPED_FEET
from rlctl_locomotion.quadruped import JOINTS as QUADRUPED_JOINTS

CONTROL_DT = 0.02  # [s]
CLIPS = Path(__file__).with_name("clips")


def read_reference(clip: str, joints: list[str]) -> Reference:
    """Return the clip of a name, at the rate of control."""
    return Reference([read_motion(CLIPS / f"{clip}.csv")], joints, CONTROL_DT)


def list_terms(reference: Reference) -> dict[str, terms.Term]:
    """Return what is observed: what the robot measures, and what the clip wants next."""
    tables = {name: table.tolist() for name, table in reference.tabulate().items()}
    return {
        "gravity": terms.Gravity("orientation"),
        "joint_error": terms.Playback(tables["joints"], CONTROL_DT, "joint_positions"),
        "joints": terms.Playback(tables["joints"], CONTROL_DT),
        "motion": terms.Playback(tables["motion"], CONTROL_DT),
        "last_action": terms.LastAction(),
    }


def mirror_clip(other_side: tuple[int, ...]) -> dict[str, Sequence[int]]:
    """Return the mirror image of a robot, whose joints `other_side` exchanges, and of what its clip wants."""
    count = len(other_side)
    # After the speeds of the joints: the direction of gravity, the velocity, the turning, and the height.
    signs = (1, -1, 1, 1, -1, 1, -1, 1, -1, 1)
    motion = (*other_side, *(sign * (count + 1 + index) for index, sign in enumerate(signs)))
    joints = ("joint_error", "joints", "joint_velocities", "last_action", "action")
    return {
        "gyroscope": (-1, 2, -3),
        "gravity": (1, -2, 3),
        "motion": motion,
        **dict.fromkeys(joints, other_side),
        "velocity": (1, -2, 3),
        "deviations": (1, 2, 3, 4, 5),
        "time": (1,),
        "events/push": (1, -2),  # speed and direction
    }


@dataclass
class Follow(Driven):
    """What the tasks share: starts in a row of the clip, joint targets about the next row, and how far it is off."""

    tolerance: float = 0.15  # [rad], largest mean error of the joints in an episode that succeeds
    start_noise: float = 0.05  # [rad], of every joint, to each side of the clip
    random_start: bool = True  # otherwise every episode begins with the clip

    row: np.ndarray = field(init=False, repr=False)  # of the clip, which the robot should have reached
    error_sum: np.ndarray = field(init=False, repr=False)  # [rad], over the steps of the episode
    deviations: np.ndarray = field(init=False, repr=False)  # what the critic sees of `Deviation`

    reference: ClassVar[Reference]
    links: ClassVar[tuple[str, ...]]  # compared with the clip, relative to the root
    size: ClassVar[float]  # [m], height of the root above the ground; distances scale with it
    tilt_limit: ClassVar[float] = 0.8  # [rad], where an episode ends
    reach: ClassVar[float | np.ndarray] = 0.25

    control_dt, substeps, solver_iterations = CONTROL_DT, 2, 4
    deployed_parameters = {"random_start": False}
    action_meaning = "joint angles from the clip; 1 is 0.25 rad"
    reward_weights = {
        "joints": 0.3,
        "joint_velocities": 0.1,
        "links": 0.2,
        "heights": 0.15,
        "tilt": 0.15,
        "velocity": 0.15,
        "turning": 0.1,
        "smoothness": -0.01,
        "fall": -1.0,
        "joint_error": 0.0,  # [rad]
        "heading_error": 0.0,  # [rad]; the policy measures no heading
        "place_error": 0.0,  # [m]; nor where it stands
    }
    events = {
        **Driven.events,
        "position_noise": Event("observation", events.noise, of="joint_error", std=(0.0, 0.01)),  # [rad]
        "push": Event("interval", events.kick, every_s=3.0, body="robot", speed=(0.0, 0.4)),  # [m/s]
    }
    rlctl_ignore = {
        "RL106": "action 1 is about what it needs; up to 4 it may target angles out of reach, for force",
        "RL611": "following a clip is what training is for; random actions fall",
    }

    def build(self, sim: Sim) -> None:
        """Load ground and robot, and compute where its links are in the clip."""
        super().build(sim)
        self.reference.locate(self.body, self.links)

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        """Begin in a row of the clip."""
        rows = self.reference.draw(rng, self.level[worlds])
        if not self.random_start:
            rows = self.reference.starts[self.reference.clip_of[rows]]
        self.row[worlds] = rows
        noise = rng.uniform(-self.start_noise, self.start_noise, len(self.joint_order))
        self.reference.place(self.body, rows, worlds, noise)

    @property
    def rows(self) -> np.ndarray:
        """The row of the clip in each world, as whole numbers."""
        return self.row.astype(int)

    def act(self, action: np.ndarray) -> None:
        """Set the joints' targets about the next row of the clip."""
        rows = self.reference.following[self.rows]
        self.row[:] = rows
        self.body.drive_to(self.reference.joint_positions[rows] + self.reach * action)
        self.action_change = action - self.last_action
        self.last_action = action.astype(float)
        self.steps += 1

    def is_terminated(self) -> np.ndarray:
        """It is too far from the clip: a link is higher or lower by a third of its size, or it tilts."""
        self.deviation = now = self.reference.compare(self.body, self.rows)
        self.deviations = np.stack([now.links, now.heights, now.tilt, now.velocity, now.turning], axis=1)
        self.error_sum += now.joints
        self.fallen = (now.heights > self.size / 3) | (now.tilt > self.tilt_limit)
        return self.fallen

    def is_truncated(self) -> np.ndarray:
        """The clip has ended."""
        rows = self.rows
        return self.reference.following[rows] == rows

    def next_levels(self) -> np.ndarray:
        """Return where the next episodes start: half of those after a failure a little before it."""
        return self.reference.find_levels(self.rows, ~self.is_success())

    def place_reference(self) -> None:
        """Be where the clip is."""
        self.reference.place(self.body, self.rows, np.arange(self.worlds))

    def observe(self) -> dict[str, Any]:
        """Return what the robot's own sensors measure, the time in the clip, and the last action."""
        orientation, time = self.body.base_orientation, self.row[:, None] * CONTROL_DT
        return {
            "gyroscope": rotate_inverse(orientation, self.body.base_angular_velocity),
            "gravity": orientation,
            "joint_error": (self.body.joint_positions, time),
            "joint_velocities": self.body.joint_velocities,
            "joints": time,
            "motion": time,
            "last_action": self.last_action,
        }

    def privileged(self) -> dict[str, np.ndarray]:
        """Return the velocity, how far the robot is off, and when in the clip it is."""
        velocity = rotate_inverse(self.body.base_orientation, self.body.base_velocity)
        return {"velocity": velocity, "deviations": self.deviations, "time": self.row[:, None] / len(self.reference)}

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Return how closely the clip is followed, and how calmly."""
        now = self.deviation
        return {
            "joints": rewards.closeness(now.joints, 0.2),
            "joint_velocities": rewards.closeness(now.joint_velocities, 3.0),
            "links": rewards.closeness(now.links, 0.2 * self.size),
            "heights": rewards.closeness(now.heights, 0.15 * self.size),
            "tilt": rewards.closeness(now.tilt, 0.3),
            "velocity": rewards.closeness(now.velocity, self.size),
            "turning": rewards.closeness(now.turning, 2.0),
            "smoothness": rewards.squared(self.action_change),
            "fall": self.fallen.astype(float),
            "joint_error": now.joints,
            "heading_error": now.heading,
            "place_error": now.place,
        }

    def is_success(self) -> np.ndarray:
        """It has followed so far, and its joints were on average within `tolerance`."""
        return ~self.fallen & (self.error_sum <= self.tolerance * np.maximum(self.steps, 1))

    def describe_joints(self) -> Joints:
        """The robot's, in the order of the action, which corrects the clip."""
        return self.body.describe_joints(
            self.joint_order,
            default_positions=self.reference.joint_positions[0],
            action_correction=self.reach,
            reference="joints",
            measured="joint_positions",
        )


@dataclass
class HumanoidBow(Follow):
    """Bow, stand up, squat with stretched arms, and stand up again, from any frame to the end."""

    tolerance: float = 0.1  # [rad]
    episode_s: float = 6.6  # [s], of the clip

    robot = "humanoid of 26 kg"
    model: ClassVar[str | Path] = HumanoidWalk.model
    joint_order: ClassVar[list[str]] = HUMANOID_JOINTS
    reference: ClassVar[Reference] = read_reference("humanoid-bow", HUMANOID_JOINTS)
    links: ClassVar[tuple[str, ...]] = (*HUMANOID_FEET, "left_shin", "right_shin", "left_forearm", "right_forearm")
    size: ClassVar[float] = 0.6
    stiffness: ClassVar[float | np.ndarray] = HumanoidWalk.stiffness
    damping: ClassVar[float | np.ndarray] = HumanoidWalk.damping
    armature: ClassVar[float | np.ndarray] = HumanoidWalk.armature
    start_height: ClassVar[float] = HumanoidWalk.start_height

    action_space = Box(-4.0, 4.0, (16,), np.float32)
    observation_terms = list_terms(reference)
    mirror = mirror_clip(HUMANOID_OTHER_SIDE)
    per_world = {
        "row": (),
        "steps": (),
        "error_sum": (),
        "deviations": (5,),
        "last_action": (16,),
        "action_change": (16,),
    }


@dataclass
class QuadrupedBow(Follow):
    """Bow with the front legs, then lower the hind legs, and stand up, from any frame to the end."""

    tolerance: float = 0.05  # [rad]; with 0.15 zero actions would do
    episode_s: float = 5.4  # [s], of the clip

    joint_order: ClassVar[list[str]] = QUADRUPED_JOINTS
    reference: ClassVar[Reference] = read_reference("quadruped-bow", QUADRUPED_JOINTS)
    links: ClassVar[tuple[str, ...]] = QUADRUPED_FEET
    size: ClassVar[float] = 0.3

    observation_terms = list_terms(reference)
    mirror = mirror_clip(OTHER_SIDE)
    per_world = {
        "row": (),
        "steps": (),
        "error_sum": (),
        "deviations": (5,),
        "last_action": (12,),
        "action_change": (12,),
    }
