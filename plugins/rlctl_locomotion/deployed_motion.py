"""DeployedMotion: a robot that follows a clip with a policy from elsewhere, as its deployment is described."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.task import CommandTerm, Sim, TaskError, WorldRngs, rewards
from rlctl.task.deployment import ObservedPart
from rlctl.task.motion import read_motion
from rlctl.task.reference import Reference
from rlctl.task.rotations import rotate
from rlctl.task.terms import ClipOrientation, Playback
from rlctl_locomotion.deployed import Deployed

ORIENTATION_UNIT = "quaternion x, y, z, w"
TILT_LIMIT = 0.8  # [rad], more than in the clip, where an episode ends


@dataclass
class DeployedMotion(Deployed):
    """Follow a clip from any frame, for 10 s or to its end: robot, joints, gains and rate are those of a deployment."""

    motion_file: str = ""  # of the clip, as rlctl writes clips
    tolerance: float = 0.2  # [rad], largest mean error of the joints in an episode that succeeds
    random_start: bool = True  # otherwise every episode begins with the clip

    row: np.ndarray = field(init=False, repr=False)  # of the clip, which the robot should have reached
    reference: Reference = field(init=False, repr=False)

    deployed_parameters = {"random_start": False}
    reward_weights = {
        "joints": 0.3,
        "heights": 0.15,
        "tilt": 0.15,
        "smoothness": -0.01,
        "fall": -1.0,
        "joint_error": 0.0,  # [rad]
        "heading_error": 0.0,  # [rad]
    }

    def __post_init__(self) -> None:
        """Read the clip."""
        super().__post_init__()
        if not self.motion_file:
            raise TaskError("DeployedMotion: the policy follows a clip: rlctl runs import POLICY .. --motion FILE")
        clip = read_motion(Path(self.motion_file))
        self.clip_joints = list(clip.joint_names)
        self.reference = Reference([clip], self.clip_joints, self.control_dt)
        self.columns = [self.clip_joints.index(name) for name in self.joint_order]
        self.anchor = self.described.anchor
        self._define(per_world={**self.per_world, "row": ()})

    def build(self, sim: Sim) -> None:
        """Load ground and robot, and compute what is observed of the clip."""
        super().build(sim)
        body, reference = self.body, self.reference
        if self.clip_joints != list(body.joint_names):
            raise TaskError(f"{Path(self.motion_file).name}: its joints are not those of {self.model}, in their order")
        self.anchor = self.anchor or body.base_name
        reference.locate(body, [self.anchor])
        # The first frame stands on the ground, whatever floor the clip was recorded on.
        first = reference.position[0] + rotate(reference.orientation[0], reference.offset)
        reference.position[:, 2] += self.start_height - first[2]
        motion_terms = self._make_motion_terms()
        units = dict(self.observation_units)
        if "anchor_orientation" in motion_terms:
            units[self.orientation_name] = ORIENTATION_UNIT
        self._define(
            observation_terms={**self.described.make_terms(), **motion_terms},
            observation_units=units,
        )

    @property
    def orientation_name(self) -> str:
        """The quantity from which the anchor's orientation is observed."""
        return f"{self.anchor}_orientation"

    def _make_motion_terms(self) -> dict[str, Playback]:
        reference = self.reference
        wanted = np.hstack([reference.joint_positions[:, self.columns], reference.joint_velocities[:, self.columns]])
        turns = reference.link_orientations[:, 0]
        axes = np.hstack([rotate(turns, np.eye(3)[axis]) for axis in (0, 1)])
        terms = {
            "motion": Playback(wanted.tolist(), self.control_dt),
            "anchor_orientation": ClipOrientation(axes.tolist(), self.control_dt, self.orientation_name),
        }
        observed = [part.kind for part in self.described.observations]
        return {name: term for name, term in terms.items() if name in observed}

    @property
    def rows(self) -> np.ndarray:
        """The row of the clip in each world, as whole numbers."""
        return self.row.astype(int)

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        """Begin in a row of the clip."""
        rows = self.reference.draw(rng, np.ones(len(worlds)))
        if not self.random_start:
            rows = np.zeros_like(rows)
        self.row[worlds] = rows
        noise = rng.uniform(-self.start_noise, self.start_noise, len(self.clip_joints))
        self.reference.place(self.body, rows, worlds, noise)

    def act(self, action: np.ndarray) -> None:
        """Set the joints' target angles."""
        super().act(action)
        self.row[:] = self.reference.following[self.rows]

    def measure(self) -> None:
        """Compute how far the robot is from the clip, once per step."""
        self.deviation = now = self.reference.compare(self.body, self.rows)
        self.error = now.joints  # [rad]
        self.error_sum += self.error
        size = self.described.start_height
        self.fallen = (now.heights > size / 3) | (now.tilt > TILT_LIMIT)

    def is_truncated(self) -> np.ndarray:
        """The clip has ended."""
        rows = self.rows
        return self.reference.following[rows] == rows

    def place_reference(self) -> None:
        """Be where the clip is."""
        self.reference.place(self.body, self.rows, np.arange(self.worlds))

    def _measure(self, part: ObservedPart) -> Any:
        time = self.row[:, None] * self.control_dt
        if part.kind == "motion":
            return time
        if part.kind == "anchor_orientation":
            return self.body.link_orientation(self.anchor), time
        return super()._measure(part)

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Return how closely the clip is followed."""
        now = self.deviation
        return {
            "joints": rewards.closeness(now.joints, 0.2),
            "heights": rewards.closeness(now.heights, 0.15 * self.described.start_height),
            "tilt": rewards.closeness(now.tilt, 0.3),
            "smoothness": rewards.squared(self.action_change),
            "fall": self.fallen.astype(float),
            "joint_error": now.joints,
            "heading_error": now.heading,
        }

    def commands(self) -> dict[str, CommandTerm]:
        """None: the clip says what to do."""
        return {}

    def set_commands(self, values: Mapping[str, np.ndarray]) -> None:
        """None can be set."""
