"""Walk on rough ground that the robot does not see: `walk` with pushes, slippery ground, noise and delay."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rlctl.task import Body, Event, Sim, TaskError, WorldRngs, events, rough_heights
from rlctl.task.rotations import rotate_inverse
from rlctl_locomotion.clocked import Clocked
from rlctl_locomotion.quadruped import FEET

HIGHEST_BUMPS = 0.1  # [m]; above, the legs are too short
SOLE = 0.02  # [m], from the centre of a toe to the ground
START = 2.0  # [m], half of the length of the square in which episodes begin
PUSH = {"from": (0.0, 0.3), "to": (0.0, 1.0)}  # [m/s], at level 0 and at level 1
SCANNED = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-0.2, 0.2, 3), indexing="ij"), -1).reshape(-1, 2)
"""Points around the robot [m] whose heights the critic sees, in its own frame without roll and pitch."""


@dataclass
class WalkRough(Clocked):
    """Follow velocity commands over bumps that it does not see, on slippery ground, with pushes, noise and delay."""

    must_step: bool = False  # a foot that meets a bump is low
    rough: float = 0.05  # [m], height of the bumps
    terrain_seed: int = 0
    episode_s: float = 20.0

    period_s: ClassVar[float] = 0.5
    swing: ClassVar[float] = 0.09
    first_half: ClassVar[tuple[float, ...]] = (1.0, -1.0, -1.0, 1.0)  # the right front foot with the left hind one
    cell: ClassVar[float] = 0.2  # [m], between the points of the ground
    size: ClassVar[tuple[float, float]] = (50.0, 80.0)  # [m], along x and y: in an episode at most 22 m are walked
    flat_y: ClassVar[float] = -30.0  # [m], where episodes of level 0 begin
    hardest_y: ClassVar[float] = 15.0  # [m], where those of level 1 begin
    scale = 0.4
    # Lower than on flat ground, for quick corrections after pushes; what -0.012 does here was not measured.
    reward_weights = {**Clocked.reward_weights, "smoothness": -0.005, "tracking": 0.3, "turning": 0.15, "gait": 0.3}

    mirror = {
        **Clocked.mirror,
        "velocity": (1, -2, 3),
        "height": (1,),
        "foot_heights": (2, 1, 4, 3),
        "ground": (3, 2, 1, 6, 5, 4, 9, 8, 7, 12, 11, 10, 15, 14, 13),
        "events/push": (1, -2),  # speed and direction
    }
    events = {
        "mass": Event("reset", events.scale_mass, body="robot", factor=(0.8, 1.2), enabled=True),
        "friction": Event("reset", events.set_friction, body="ground", friction=(0.3, 1.3), enabled=True),
        "motor_strength": Event("reset", events.scale_motor_strength, body="robot", factor=(0.8, 1.0), enabled=True),
        "gyroscope_noise": Event("observation", events.noise, of="gyroscope", std=(0.0, 0.2), enabled=True),  # [rad/s]
        "gravity_noise": Event("observation", events.noise, of="gravity", std=(0.0, 0.03), enabled=True),
        "position_noise": Event("observation", events.noise, of="joint_positions", std=(0.0, 0.01), enabled=True),
        "velocity_noise": Event("observation", events.noise, of="joint_velocities", std=(0.0, 1.0), enabled=True),
        "action_delay": Event("action", events.delay, steps=(0, 1), enabled=True),  # of 20 ms
        "push": Event("interval", events.kick, every_s=4.0, body="robot", speed=PUSH, enabled=True),
    }

    def load_ground(self, sim: Sim) -> Body:
        """Load ground that gets rougher along y."""
        heights = self.draw_heights()
        y = (np.arange(heights.shape[1]) - (heights.shape[1] - 1) / 2) * self.cell
        self.heights = heights * np.clip(self.find_roughness(y), 0.0, 1.0)
        return sim.add_height_field("ground", self.heights, cell=self.cell)

    def draw_heights(self) -> np.ndarray:
        """Return bumps of full height, shape (along x, along y) [m]; raises `TaskError` for some that are too high."""
        if not 0 <= self.rough <= HIGHEST_BUMPS:
            raise TaskError(f"rough: bumps of {self.rough:g} m; give a height from 0 to {HIGHEST_BUMPS:g} m")
        return rough_heights(self.terrain_seed, size=self.size, cell=self.cell, roughness=self.rough)

    def find_roughness(self, y: np.ndarray) -> np.ndarray:
        """Return how rough the ground is at y [m]: flat at 0, of full height at 1."""
        return 1.0 - y / self.flat_y

    def draw_place(self, rng: WorldRngs, worlds: np.ndarray) -> np.ndarray:
        """Return where the trunk starts [m], shape (k, 3): on ground as rough as the world's level says."""
        place = rng.uniform(-START, START, 2)
        place[:, 1] += self.flat_y + (self.hardest_y - self.flat_y) * self.level[worlds]
        around = self.find_heights(place[:, None] + SCANNED)
        return np.column_stack([place, self.start_height + around.max(axis=1)])

    def privileged(self) -> dict[str, np.ndarray]:
        """Return the velocity, the heights of trunk and feet above the ground, and the ground around the robot."""
        position, orientation = self.body.base_position, self.body.base_orientation
        x, y, z, w = orientation.T
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))[:, None]
        forward, left = SCANNED.T
        around = np.stack([np.cos(yaw) * forward - np.sin(yaw) * left, np.sin(yaw) * forward + np.cos(yaw) * left], -1)
        ground = self.find_heights(position[:, :2])
        return {
            "velocity": rotate_inverse(orientation, self.body.base_velocity),
            "height": (position[:, 2] - ground)[:, None],
            "foot_heights": self.measure_feet(),
            "ground": self.find_heights(position[:, None, :2] + around) - ground[:, None],
        }

    def measure_feet(self) -> np.ndarray:
        """Return the heights of the soles above the ground [m], shape (worlds, 4)."""
        feet = np.stack([self.body.link_position(foot) for foot in FEET], 1)
        return feet[..., 2] - SOLE - self.find_heights(feet[..., :2])

    def find_heights(self, places: np.ndarray) -> np.ndarray:
        """Return the heights of the ground [m] at places (..., 2) [m], between the points of the grid bilinearly."""
        last = np.array(self.heights.shape) - 1
        position = np.clip(places / self.cell + last / 2, 0.0, last - 1e-9)
        corner = position.astype(int)
        (x, y), (right, up) = np.moveaxis(corner, -1, 0), np.moveaxis(position - corner, -1, 0)
        low = self.heights[x, y] * (1 - right) + self.heights[x + 1, y] * right
        high = self.heights[x, y + 1] * (1 - right) + self.heights[x + 1, y + 1] * right
        return low * (1 - up) + high * up

    def measure_height(self) -> np.ndarray:
        """Return the height of the trunk above the ground [m]."""
        position = self.body.base_position
        return position[:, 2] - self.find_heights(position[:, :2])
