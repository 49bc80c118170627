"""What the robots with legs share: the ground they walk on, their feet, falling, and actions that change."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from rlctl.task import Body, Sim, Task, TaskError, rewards, rough_heights

LENGTH = 96.0  # [m] of rough ground, along x: a biped runs at 1.4 m/s, so 28 m in an episode
CELL = 0.12  # [m]


@dataclass
class Legged(Task):
    """A robot with a trunk and feet, whose `build` loads its `body` after `build_ground`."""

    roughness: float = 0.0  # [m], height of the steps in the ground
    terrain_seed: int = 0
    start_noise: float = 0.05  # [rad], of every joint, to each side of the start pose

    body: Body = field(init=False, repr=False)
    ground: Body = field(init=False, repr=False)

    feet: ClassVar[tuple[str, ...]]
    """Names of the links that touch the ground."""
    fallen_height: ClassVar[float]
    """Height of the trunk's middle below which the robot has fallen [m]."""
    highest_step: ClassVar[float]
    """The roughest ground that the legs can be expected to walk on [m]."""
    ground_width: ClassVar[float] = 12.0
    """Of rough ground, across the way [m]."""

    def build_ground(self, sim: Sim) -> None:
        """Load the ground as body `ground`: flat, or with steps of up to `roughness` [m] but at the start.

        Raises `TaskError` for steps above `highest_step`, which a leg cannot get over, or which bury the robot.
        """
        if self.roughness > self.highest_step:
            raise TaskError(
                f"roughness: steps of {self.roughness:g} m would bury this robot's legs. "
                f"Use at most {self.highest_step:g} m."
            )
        if self.roughness == 0:
            self.ground = sim.load("ground", "plane.urdf", fixed=True)
        else:
            size = (LENGTH, self.ground_width)
            heights = rough_heights(self.terrain_seed, size=size, cell=CELL, roughness=self.roughness, flat_radius=0.6)
            self.ground = sim.add_height_field("ground", heights, cell=CELL)
        self.ground.set_friction(1.0)

    def begin(self, joints: int) -> None:
        """Begin an episode of a robot with so many `joints`, which has just been put at its start."""
        self.last_action = self.action_change = np.zeros(joints, np.float32)
        self.update()
        self.foot_contacts = np.zeros(len(self.feet))  # what is known of contacts before a step is of the last episode

    def update(self) -> None:
        """Read what rewards and observations share, once per step."""
        self.trunk = self.body.mass_state("trunk")
        self.attitude = self.trunk.roll_pitch_yaw  # [rad]
        touching = self.body.links_touching(self.ground)
        self.foot_contacts = np.array([float(foot in touching) for foot in self.feet])

    def note_action(self, action: np.ndarray) -> None:
        """Remember an action, and how it differs from the one before."""
        self.action_change, self.last_action = action - self.last_action, action

    def draw_pose(self, rng: np.random.Generator, pose: np.ndarray) -> np.ndarray:
        """Return joint angles [rad] near `pose`, of the same shape."""
        return pose + rng.uniform(-self.start_noise, self.start_noise, pose.shape)

    def is_terminated(self) -> bool:
        """The robot has fallen."""
        self.update()
        return self.is_fallen()

    def is_fallen(self) -> bool:
        """Say whether the trunk is down."""
        return rewards.fallen(self.trunk.position[2], self.fallen_height) > 0
