"""Tasks in batches with one mistake each, which shows only with several worlds, next to the sound one."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rlctl.task import BatchTask, Box, Sim, WorldRngs, rewards

CART = Path(__file__).with_name("cart.urdf")


@dataclass
class Point(BatchTask):
    """Turn the arm to an angle."""

    control_dt, substeps, episode_s = 0.05, 4, 2.0
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    action_meaning = "angle of the shoulder, 1 is 0.9 rad"
    observation_units = {"angle": "rad", "speed": "rad/s", "goal": "rad"}
    reward_weights = {"near": 1.0, "change": -0.05}
    per_world = {"goal": (), "last_action": (1,), "change": ()}

    def build(self, sim: Sim) -> None:
        self.body = sim.load("cart", CART, fixed=True)

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        start = rng.uniform(-0.8, 0.8, 1)
        self.body.set_joints(start, worlds=worlds)
        self.goal[worlds] = start[:, 0] + 0.6 * np.where(start[:, 0] > 0, -1.0, 1.0) * rng.uniform(1.0, 1.5)

    def act(self, action: np.ndarray) -> None:
        self.body.drive_to(0.9 * action)
        self.change = rewards.change(action.astype(float), self.last_action)
        self.last_action = action.astype(float)

    def error(self) -> np.ndarray:
        return self.body.joint_positions[:, 0] - self.goal

    def observe(self) -> dict[str, np.ndarray]:
        return {
            "angle": self.body.joint_positions,
            "speed": self.body.joint_velocities,
            "goal": self.goal[:, None],
            "last_action": self.last_action,
        }

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        return {"near": rewards.closeness(self.error(), 0.3), "change": self.change}

    def is_success(self) -> np.ndarray:
        return np.abs(self.error()) < 0.05


class RL406ScalesByAll(Point):
    def observe(self):
        speed = self.body.joint_velocities
        return {**super().observe(), "speed": speed / max(1.0, np.abs(speed).max())}


class RL406ScalesByEach(Point):
    def observe(self):
        speed = self.body.joint_velocities
        return {**super().observe(), "speed": speed / np.maximum(1.0, np.abs(speed))}


class RL406SharesNoise(Point):
    def reset(self, rng, worlds):
        super().reset(rng, worlds)
        self.goal[worlds] += 0.01 * len(worlds)


class RL407ResetsAllGoals(Point):
    def reset(self, rng, worlds):
        super().reset(rng, worlds)
        self.goal[:] = np.clip(self.goal[worlds][0], -0.9, 0.9)


class RL407ResetsItsGoal(Point):
    def reset(self, rng, worlds):
        super().reset(rng, worlds)
        self.goal[worlds] = np.clip(self.goal[worlds], -0.9, 0.9)


class RL407MovesAllBases(Point):
    def reset(self, rng, worlds):
        self.body.set_base([0.0, 0.0, float(rng.uniform(0.0, 0.1)[0])])
        super().reset(rng, worlds)


class RL407MovesItsBase(Point):
    def reset(self, rng, worlds):
        height = rng.uniform(0.0, 0.1)
        self.body.set_base(np.stack([0 * height, 0 * height, height], axis=1), worlds=worlds)
        super().reset(rng, worlds)


class RL408OneRow(Point):
    def rewards(self, action):
        return {**super().rewards(action), "change": np.array([self.change.mean()])}


class RL408OneGoal(Point):
    def build(self, sim):
        super().build(sim)
        self.offset = np.zeros((1, 2))

    def error(self):
        return super().error() + self.offset.reshape(self.worlds, 2)[:, 0]


class RL409CountsSteps(Point):
    def reset(self, rng, worlds):
        super().reset(rng, worlds)
        self.steps = 0

    def act(self, action):
        super().act(action)
        self.steps += 1

    def observe(self):
        return {**super().observe(), "time": np.full((self.worlds, 1), self.steps / 40)}


class RL409CountsStepsOfEach(Point):
    per_world = {**Point.per_world, "steps": ()}

    def act(self, action):
        super().act(action)
        self.steps += 1

    def observe(self):
        return {**super().observe(), "time": self.steps[:, None] / 40}


class RL409KeepsLast(Point):
    per_world = {"goal": (), "change": ()}

    def build(self, sim):
        super().build(sim)
        self.last_action = np.zeros((self.worlds, 1))

    def reset(self, rng, worlds):
        super().reset(rng, worlds)
        self.last_action[worlds] = 0.0


class RL409Logs(Point):
    def rewards(self, action):
        self.mean_error = float(np.abs(self.error()).mean())
        return super().rewards(action)


class CachesAndForgetsTheSeed(Point):
    """The error is computed in each step, and the goals are not drawn from the seed."""

    rlctl_ignore = {"RL301": "it is what the test is about", "RL308": "a consequence"}

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        super().reset(rng, worlds)
        self.goal[worlds] += np.random.default_rng().uniform(-0.1, 0.1, len(worlds))

    def act(self, action: np.ndarray) -> None:
        super().act(action)
        self.cached_error = self.error()
