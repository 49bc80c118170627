"""Robots that are paid for progress from goal to goal, and robots that see vectors turned, next to their twins."""

import mujoco
import numpy as np
import pybullet as p
from broken_links import Gantry
from broken_meaning import Robot
from robots import Pusher


def turn(angle):
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine], [sine, cosine]])


class Course(Robot):
    """A rover drives along goals that are drawn at once; it sees the way in its frame."""

    rlctl_ignore = {"RL611": "the course is long"}
    refreshes = True

    def start(self):
        self.place, self.heading = np.zeros(2), self.np_random.uniform(-3, 3)
        self.goals, self.index = self.np_random.uniform(-4, 4, (5, 2)), 0
        self.before, self.progress = self.distance(), 0.0

    def move(self, action):
        self.heading += 0.1 * action[1]
        self.place = self.place + 0.1 * action[0] * turn(self.heading)[:, 0]
        self.progress, self.before = self.before - self.distance(), self.distance()
        if self.distance() < 0.4 and self.index < 4:
            self.index += 1
            self.before = self.distance() if self.refreshes else self.before

    def distance(self):
        return float(np.linalg.norm(self.goals[self.index] - self.place))

    def observe(self):
        way = turn(self.heading).T @ (self.goals[self.index] - self.place)
        return np.array([*way, np.cos(self.heading), np.sin(self.heading)], np.float32)

    def reward(self, action):
        return 10 * self.progress - 0.01 * np.square(action).sum()

    def result(self, reward, success):
        return self.observe(), float(reward), False, self.steps >= self.limit, {"is_success": self.index >= 4}


class RL627CourseOldGoal(Course):
    refreshes = False


class Rounds(Gantry):
    """A tool on two rails gets another goal wherever it was at one."""

    rlctl_ignore = {"RL110": "its rails are level", "RL609": "it never ends"}
    refreshes = True

    def start(self):
        super().start()
        self.before, self.progress = self.distance(), 0.0

    def move(self, action):
        super().move(action)
        self.progress, self.before = self.before - self.distance(), self.distance()
        if self.distance() < 0.1:
            self.goal = np.array([*self.np_random.uniform([-0.7, -0.3], [0.7, 0.9]), 0.2])
            self.before = self.distance() if self.refreshes else self.before

    def reward(self, action):
        return 20 * self.progress - 0.02 * np.square(action).sum()

    def result(self, reward, success):
        observation, _, _, truncated, _ = super().result(reward, success)
        return observation, float(reward), False, truncated, {}


class RL627RoundsOldGoal(Rounds):
    refreshes = False


class CrankRounds(Pusher):
    """Its crank gets another place on the table wherever it was at one."""

    refreshes = True

    def size(self):
        return super().size() + 2

    def start(self):
        super().start()
        self.draw()
        self.before = self.distance()

    def draw(self):
        angle, reach = self.np_random.uniform([-0.6, 0.2], [0.6, 0.3])
        self.goal = reach * np.array([np.cos(angle), np.sin(angle)])

    def distance(self):
        tip = p.getLinkState(self.robot, 2, computeForwardKinematics=True, physicsClientId=self.client)[4][:2]
        return float(np.linalg.norm(self.goal - tip))

    def observe(self):
        tip = p.getLinkState(self.robot, 2, computeForwardKinematics=True, physicsClientId=self.client)[4][:2]
        return np.concatenate([super().observe(), self.goal - tip]).astype(np.float32)

    def is_success(self):
        return False

    def reward(self):
        progress, self.before = self.before - self.distance(), self.distance()
        if self.distance() < 0.03:
            self.draw()
            self.before = self.distance() if self.refreshes else self.before
        return 5 * progress


class RL627CrankOldGoal(CrankRounds):
    refreshes = False


class Copter(Robot):
    """A drone in the vertical plane, in one vector; it sees its velocity in its frame, with noise."""

    def start(self):
        angle = self.np_random.uniform(-0.5, 0.5)
        self.state = np.array([*self.np_random.uniform(-1, 1, 2), angle, *self.np_random.uniform(-0.5, 0.5, 2), 0.0])

    def move(self, action):
        for _ in range(4):
            *_, angle, x_speed, z_speed, rate = self.state
            push = turn(angle) @ [0.0, 9.81 + 5 * action[0]] - [0.0, 9.81]
            self.state = self.state + 0.005 * np.array([x_speed, z_speed, rate, *push, 10 * action[1] - 2 * rate])

    def seen(self):
        return turn(self.state[2]).T @ self.state[3:5]

    def observe(self):
        noise = self.np_random.normal(0.0, 0.01, 2)
        angle = self.state[2]
        return np.array(
            [*self.state[:2], np.sin(angle), np.cos(angle), *(self.seen() + noise), self.state[5]], np.float32
        )

    def distance(self):
        return float(np.linalg.norm(self.state[:2]))

    def reward(self, action):
        return -self.distance()


class RL124CopterWrongWay(Copter):
    def seen(self):
        return turn(self.state[2]) @ self.state[3:5]


class Omni(Robot):
    """A base that drives in all directions, whose actions are velocities in its frame."""

    numbers = 3

    def start(self):
        self.place, self.yaw, self.velocity = np.zeros(2), self.np_random.uniform(-3, 3), np.zeros(2)
        self.goal = self.np_random.uniform(-2, 2, 2)

    def move(self, action):
        self.velocity = 0.6 * self.velocity + 0.4 * turn(self.yaw) @ action[:2]
        self.place = self.place + 0.1 * self.velocity
        self.yaw += 0.2 * action[2]

    def seen(self):
        return turn(self.yaw).T @ self.velocity

    def observe(self):
        return np.array([*(turn(self.yaw).T @ (self.goal - self.place)), *self.seen()], np.float32)

    def distance(self):
        return float(np.linalg.norm(self.goal - self.place))

    def reward(self, action):
        return -self.distance()


class RL124OmniWrongWay(Omni):
    def seen(self):
        return turn(self.yaw) @ self.velocity


class Diver(Robot):
    """A submarine in space, whose attitude is a matrix; it sees gravity in its frame."""

    rlctl_ignore = {"RL603": "it sinks and rises far"}
    numbers = 4

    def start(self):
        self.place, self.velocity, self.rates = self.np_random.uniform(-1, 1, 3), np.zeros(3), np.zeros(3)
        self.attitude = np.eye(3)
        self.attitude[:2, :2] = turn(self.np_random.uniform(-3, 3))

    def move(self, action):
        for _ in range(3):
            self.rates = self.rates + 0.02 * (4 * action[1:] - self.rates)
            quaternion = np.zeros(4)
            mujoco.mju_axisAngle2Quat(
                quaternion, self.rates / max(np.linalg.norm(self.rates), 1e-9), 0.02 * np.linalg.norm(self.rates)
            )
            step = np.zeros(9)
            mujoco.mju_quat2Mat(step, quaternion)
            self.attitude = self.attitude @ step.reshape(3, 3)
            push = self.attitude @ [9.81 * action[0], 0.0, 9.0] - [0.0, 0.0, 9.81]
            self.velocity = self.velocity + 0.02 * (push - 0.5 * self.velocity)
            self.place = self.place + 0.02 * self.velocity

    def seen(self):
        return self.attitude.T @ [0.0, 0.0, -1.0]

    def observe(self):
        return np.array([*self.place, *self.seen(), *(self.attitude.T @ self.velocity), *self.rates], np.float32)

    def distance(self):
        return float(np.linalg.norm(self.place))

    def reward(self, action):
        return -self.distance()


class RL124DiverWrongWay(Diver):
    def seen(self):
        return self.attitude @ [0.0, 0.0, -1.0]
