"""The arm of `robots.py` with places to bring its hand to; some are out of its reach. PyBullet."""

import numpy as np
from robots import Arm


class Reacher(Arm):
    """Its tip is at most 0.82 m from its base, and hardly moves along y."""

    farthest = 0.6  # goal, from the base [m]
    rlctl_ignore = {**Arm.rlctl_ignore, "RL619": "it hardly moves along y, where goals are, too"}

    def start(self):
        super().start()
        self.goal = self.draw_goal()

    def draw_goal(self):
        direction = self.np_random.normal(size=3)
        return self.np_random.uniform(0.3, self.farthest) * direction / np.linalg.norm(direction)

    def size(self):
        return super().size() + 3

    def to_goal(self):
        return self.goal - np.array(self.hand()[4])

    def observe(self):
        return np.concatenate([super().observe(), self.to_goal()]).astype(np.float32)

    def is_success(self):
        return bool(np.linalg.norm(self.to_goal()) < 0.2)

    def reward(self):
        return -float(np.linalg.norm(self.to_goal()))

    def info(self, success):
        return {"is_success": success}


class ReacherOfThePlane(Reacher):
    """Its goals are in the plane in which it moves."""

    rlctl_ignore = Arm.rlctl_ignore

    def draw_goal(self):
        goal = super().draw_goal()
        goal[1] = np.clip(goal[1], -0.1, 0.1)
        return goal


class RL619ReacherFarGoals(ReacherOfThePlane):
    farthest = 1.4
