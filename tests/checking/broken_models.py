"""Tasks of rlctl that load a cart: one whose file is fine, and others with a mistake in theirs."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rlctl.task import Box, Task, rewards

CART = Path(__file__).parent / "cart.urdf"


@dataclass
class CartTask(Task):
    """A cart's arm is turned; nothing is wrong with it."""

    control_dt, substeps, episode_s = 1 / 60, 4, 0.5
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    reward_weights = {"angle": -1.0}
    file = CART

    def build(self, sim):
        sim.load("floor", "plane.urdf", fixed=True)
        self.cart = sim.load("cart", self.file, position=(0, 0, 0.051))

    def reset(self, rng):
        self.cart.set_joints(rng.uniform(-0.5, 0.5, 1))

    def act(self, action):
        self.cart.drive_at(3.0 * action)

    def observe(self):
        return {"angle": self.cart.joint_positions, "speed": self.cart.joint_velocities}

    def rewards(self, action):
        return {"angle": float(abs(self.cart.joint_positions[0] - 0.3))}

    def is_success(self):
        return bool(abs(self.cart.joint_positions[0] - 0.3) < 0.1)


@dataclass
class RL620CartSmooth(CartTask):
    """It also keeps its motions smooth; nothing is wrong with it."""

    reward_weights = {"angle": -1.0, "smoothness": -0.1}

    def reset(self, rng):
        super().reset(rng)
        self.last = self.action = np.zeros(1)

    def act(self, action):
        self.last, self.action = self.action, action.copy()
        super().act(action)

    def rewards(self, action):
        return {**super().rewards(action), "smoothness": rewards.change(self.action, self.last)}


@dataclass
class RL620CartComparesWithItself(RL620CartSmooth):
    def act(self, action):
        super().act(action)
        self.last = self.action


@dataclass
class RL621CartSignTwice(CartTask):
    reward_weights = {"error": -1.0}

    def rewards(self, action):
        return {"error": -float(abs(self.cart.joint_positions[0] - 0.3))}


@dataclass
class RL809TipWithoutInertial(CartTask):
    """The tip has no <inertial>."""

    file = CART.with_name("cart_without_inertial.urdf")


@dataclass
class RL809HeavyInertia(CartTask):
    """The arm turns like a body of tons."""

    file = CART.with_name("cart_of_tons.urdf")


@dataclass
class NoEffort(CartTask):
    """The model gives the arm's joint an effort limit of 0."""

    file = CART.with_name("cart_without_effort.urdf")
