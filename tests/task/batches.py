"""A small task for many worlds at once: a stool that moves its two legs on the ground, pushed and with noise."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rlctl.task import BatchTask, Box, Camera, Event, Sim, WorldRngs, events, rewards

MODEL = Path(__file__).with_name("stool.urdf")
HIPS = ("front_hip", "back_hip")


def quiver(rng, first, *, size: events.NotNegative):
    """A signal of a user's own: a sine whose phase is drawn."""
    drawn, phase, step = float(rng.uniform(*size)), rng.uniform(0, 6), iter(range(1000))

    def disturb(parts):
        shift = drawn * np.sin(phase + next(step))
        return {name: value + shift for name, value in parts.items()}

    return {"size": drawn}, disturb


@dataclass
class Stool(BatchTask):
    """Keep the seat where it should be; what `fault` names goes wrong in the third step of an episode."""

    fault: str = ""
    faulty_start: float = 2.0  # [m], the fault is in episodes whose goal is higher

    robot = "stool"
    control_dt, substeps, solver_iterations = 0.02, 4, 4
    episode_s = 0.6
    action_space = Box(-1.0, 1.0, (2,), np.float32)
    action_meaning = "hip angles [rad]"
    observation_units = {"hips": "rad", "speeds": "rad/s", "torques": "N m"}
    reward_weights = {"height": 1.0, "effort": -0.1, "time": 0.0}
    per_world = {"goal": (), "last": (2,), "steps": (), "seen": (2,)}
    events = {
        "mass": Event("reset", events.scale_mass, body="stool", factor=(0.7, 1.5)),
        "friction": Event("reset", events.set_friction, body="ground", friction=(0.3, 1.2)),
        "strength": Event("reset", events.scale_motor_strength, body="stool", factor=(0.5, 1.0)),
        "gravity": Event("reset", events.shift_gravity, change=(-1.0, 1.0)),
        "damping": Event("reset", events.scale_joint_damping, body="stool", factor=(0.5, 2.0)),
        "offset": Event("start", events.offset_joints, body="stool", position=(-0.2, 0.2), velocity=(-1.0, 1.0)),
        "kick": Event("interval", events.kick, every_s=0.1, body="stool", speed=(0.0, 0.5)),
        "push": Event("interval", events.push, every_s=0.14, body="stool", force=(0.0, 10.0), duration_s=(0.02, 0.1)),
        "noise": Event("observation", events.noise, of=["hips", "torques"], std=(0.0, 0.1)),
        "late": Event("observation", events.delay, of="speeds", steps=(0, 3)),
        "late_noise": Event("observation", events.noise, of="speeds", std=(0.1, 0.2)),
        "quiver": Event("observation", quiver, of="height", size=(0.0, 0.1)),
        "action_noise": Event("action", events.noise, std=(0.0, 0.2)),
        "late_action": Event("action", events.delay, steps=(0, 2)),
    }

    def build(self, sim: Sim) -> None:
        sim.load("ground", "plane.urdf", fixed=True)
        self.body = sim.load("stool", MODEL, position=(0.0, 0.0, 0.3))
        self.body.set_drives(30.0, 1.0, armature=0.01)

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        self.body.set_base(np.tile([0.0, 0.0, 0.3], (len(worlds), 1)), worlds=worlds)
        self.body.set_joints(rng.uniform(-0.3, 0.3, 2), worlds=worlds)
        self.goal[worlds] = rng.uniform(0.2, 0.3)

    def act(self, action: np.ndarray) -> None:
        self.body.drive_to(action)
        self.last[:] = action
        self.steps += 1

    def failing(self, fault: str) -> np.ndarray:
        return (self.steps == 3) & (self.goal > self.faulty_start) & (self.fault == fault)

    def observe(self) -> dict[str, np.ndarray]:
        self.seen = 0.5 * self.seen + self.body.joint_positions  # what is observed changes what is kept
        hips = np.where(self.failing("observation")[:, None], np.nan, self.body.joint_positions)
        return {
            "height": self.body.base_position[:, 2:] - self.goal[:, None],
            "velocity": self.body.base_velocity,
            "hips": hips,
            "speeds": self.body.joint_velocities,
            "torques": self.body.joint_torques,
            "seen": self.seen,
            "last": self.last,
        }

    def privileged(self) -> dict[str, np.ndarray]:
        goal = np.where(self.failing("privileged"), np.inf, self.goal)
        return {"goal": goal[:, None], "place": self.body.base_position}

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        far = np.abs(self.body.base_position[:, 2] - self.goal)
        if self.failing("unstable").any():
            velocities = np.where(self.failing("unstable")[:, None], 1e12, self.body.joint_velocities)
            self.body.set_joints(self.body.joint_positions, velocities)
        return {
            "height": np.where(self.failing("reward"), np.nan, rewards.closeness(far, 0.05)),
            "effort": rewards.squared(action),
            "time": 0.1 * self.steps,
        }

    def is_terminated(self) -> np.ndarray:
        return np.abs(self.body.base_velocity[:, 0]) > 1.0

    def is_success(self) -> np.ndarray:
        return np.abs(self.body.base_position[:, 2] - self.goal) < 0.05


class SeenStool(Stool):
    """The stool before a camera that stands still, and with one on its seat."""

    cameras = {
        "front": Camera(eye=(1.0, 0.0, 0.3), target=(0.0, 0.0, 0.3), size=(40, 36)),
        "seat": Camera(eye=(0.0, 0.0, 0.1), target=(0.5, 0.0, 0.0), body="stool", size=(16, 16)),
    }
    events = {
        **Stool.events,
        "light": Event("reset", events.set_light, brightness=(0.5, 1.5), azimuth=(-180, 180), elevation=(20, 90)),
        "color": Event("reset", events.set_color, body="stool", red=(0, 1), green=(0, 1), blue=(0, 1)),
        "pose": Event("reset", events.move_camera, camera="front", shift=(-0.05, 0.05), turn=(-3, 3)),
        "things": Event(
            "reset", events.set_distractors, count=(1, 3), center=(0, 0, 0), distance=(0.2, 0.4), size=(0.02, 0.05)
        ),
    }
