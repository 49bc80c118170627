"""Robots with two goals, one after the other, that are places, angles or attitudes; and robots that are paid for coming
nearer. Next to them those whose reward belongs to another goal, has a sign, or counts from the start."""

import gymnasium
import numpy as np
from broken_meaning import Robot, Rover
from broken_progress import BoatSeeks, FlyerSeeks
from broken_reach_bullet import Reacher
from gymnasium import spaces
from mujoco_robots import MujocoArm
from scipy.spatial.transform import Rotation

SWITCH = 25  # steps, after which the second goal comes


class Phases:
    """What is seen and what is paid belong to the same goal."""

    def seen_phase(self):
        return int(self.steps >= SWITCH)

    paid_phase = seen_phase


class FirstIsPaid:
    def paid_phase(self):
        return 0


class RoverPhases(Phases, Rover):
    """An array of two places."""

    rlctl_ignore = {"RL609": "it never ends"}

    def start(self):
        super().start()
        self.goals = self.place + self.np_random.uniform(-0.5, 0.5, (2, 2))

    def observe(self):
        self.goal = self.goals[self.seen_phase()]
        return super().observe()

    def reward(self, _):
        return -float(np.linalg.norm(self.goals[self.paid_phase()] - self.place))

    def result(self, reward, success):
        return self.observe(), reward, False, self.steps >= self.limit, {}


class RL638RoverPaidForTheFirst(FirstIsPaid, RoverPhases): ...


class Pointer(Phases, gymnasium.Env):
    """Turns in space to two attitudes, quaternions in a list; sees the way as a vector with noise, in a dictionary."""

    rlctl_ignore = {"RL609": "it never ends", "RL704": "it is about goals"}

    def __init__(self):
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        box = spaces.Box(-10.0, 10.0, (3,), np.float32)
        self.observation_space = spaces.Dict({"rate": box, "way": box, "late": spaces.Box(0, 1, (1,), np.float32)})

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.rate = 0, self.np_random.uniform(-0.1, 0.1, 3)
        self.attitude = Rotation.random(rng=self.np_random)
        self.targets = [Rotation.random(rng=self.np_random).as_quat() for _ in range(2)]
        return self.observe(), {}

    def way(self, phase):
        return (self.attitude.inv() * Rotation.from_quat(self.targets[phase])).as_rotvec()

    def observe(self):
        way = self.way(self.seen_phase()) + self.np_random.normal(0.0, 0.001, 3)
        seen = {"rate": self.rate, "way": way, "late": [self.seen_phase()]}
        return {name: np.asarray(value, np.float32) for name, value in seen.items()}

    def step(self, action):
        self.rate = self.rate + 0.1 * np.clip(action, -1.0, 1.0)
        self.attitude = self.attitude * Rotation.from_rotvec(0.1 * self.rate)
        self.steps += 1
        reward = float(np.exp(-np.linalg.norm(self.way(self.paid_phase()))))
        return self.observe(), reward, False, self.steps >= 60, {}


class RL638PointerPaidForTheFirst(FirstIsPaid, Pointer): ...


class ArmPhases(Phases, MujocoArm):
    """Two attributes for two places. MuJoCo."""

    rlctl_ignore = {"RL611": "it never ends"}

    def start(self):
        super().start()
        self.first_goal, self.second_goal = self.goal, self.goal + self.np_random.uniform(-0.1, 0.1, 3)

    def wanted(self, phase):
        return self.second_goal if phase else self.first_goal

    def observe(self):
        if hasattr(self, "first_goal"):
            self.goal = self.wanted(self.seen_phase())
        return super().observe()

    def reward(self, *_):
        return -float(np.linalg.norm(self.wanted(self.paid_phase()) - self.tip()))

    def succeeds(self):
        return False


class RL638ArmPaidForTheFirst(FirstIsPaid, ArmPhases):
    rlctl_ignore = {"RL611": "it never ends", "RL619": "its second goal may be out of reach"}


class FromTheStart:
    """Nothing sets the value of the step before."""

    def reward(self, *_):
        return 5.0 * (self.last - self.distance())


class RL637FlyerCountsFromTheStart(FromTheStart, FlyerSeeks): ...


class RL637BoatCountsFromTheStart(FromTheStart, BoatSeeks):
    rlctl_ignore = {"RL605": "it is paid for its phase as well"}


class ReacherSeeks(Reacher):
    rlctl_ignore = {"RL605": "a consequence", "RL611": "chance does not get there"}

    def start(self):
        super().start()
        self.previous_distance = self.distance()

    def distance(self):
        return float(np.linalg.norm(self.to_goal()))

    def reward(self):
        before, self.previous_distance = self.previous_distance, self.distance()
        return before - self.previous_distance


class RL637ReacherCountsFromTheStart(ReacherSeeks):
    rlctl_ignore = {**ReacherSeeks.rlctl_ignore, "RL619": "it hardly moves along y, where goals are, too"}

    def reward(self):
        return self.previous_distance - self.distance()


class Door(Robot):
    """A motor opens a door, once its hand is at it, to the first angle; the second one comes later."""

    rlctl_ignore = {"RL611": "chance does not stay there", "RL701": "the hand has to be at the door"}

    def start(self):
        self.hand, self.angle = 0.0, 0.0
        self.goals = self.np_random.uniform(0.4, 1.2, 2)

    def goal(self):
        return self.goals[int(self.steps >= SWITCH + 20)]

    def error(self):
        return float(abs(self.goal() - self.angle))

    distance = error

    def observe(self):
        return np.array([self.hand, self.goal(), self.goal() - self.angle, self.steps / self.limit], np.float32)

    def move(self, action):
        self.hand += 0.08 * action[0]
        self.angle += 0.1 * action[1] * (abs(self.hand) > 0.3)
        self.angle = min(max(self.angle, 0.0), 1.5)

    def reward(self, action):
        return 1.0 - self.error() - 0.01 * np.square(action).sum()

    def result(self, reward, _):
        success = self.distance() < self.near
        return self.observe(), float(reward), False, self.steps >= self.limit, {"is_success": bool(success)}


class RL622DoorWithoutASize(Door):
    """The further it is open, the more is paid."""

    def error(self):
        return float(self.goal() - self.angle)

    def distance(self):
        return abs(self.error())


class TwoHands(Robot):
    """Two hands push a block to poses, one after the other; the block sees the way to the pose, and the hands."""

    rlctl_ignore = {"RL611": "chance does not get there"}
    numbers, refreshes, sign = 4, True, 1.0

    def start(self):
        self.block = np.append(self.np_random.uniform(-0.1, 0.1, 2), self.np_random.uniform(-0.3, 0.3))
        self.left, self.right = (self.np_random.uniform(-0.5, 0.5, 2) for _ in range(2))
        self.reached = 0
        self.draw()
        self.before, self.progress = self.cost(), 0.0

    def draw(self):
        self.goal = self.np_random.uniform([-0.4, -0.4, -0.6], [0.4, 0.4, 0.6])

    def turned(self, vector):
        cosine, sine = np.cos(self.block[2]), np.sin(self.block[2])
        return np.array([cosine * vector[0] + sine * vector[1], cosine * vector[1] - sine * vector[0]])

    def distance(self):
        return float(np.linalg.norm(self.goal[:2] - self.block[:2]))

    def cost(self):
        return 4.0 * self.distance() + abs(self.goal[2] - self.block[2])

    def observe(self):
        ways = [self.turned(one[:2] - self.block[:2]) for one in (self.left, self.right, self.goal)]
        angle = self.goal[2] - self.block[2]
        return np.array([*np.concatenate(ways), np.cos(angle), np.sin(angle)], np.float32)

    def move(self, action):
        self.left = np.clip(self.left + 0.04 * action[:2], -0.6, 0.6)
        self.right = np.clip(self.right + 0.04 * action[2:], -0.6, 0.6)
        for hand, turn in ((self.left, 0.02), (self.right, -0.02)):
            if np.linalg.norm(hand - self.block[:2]) < 0.08:
                self.block = self.block + np.append(0.2 * (self.block[:2] - hand), turn)
        self.progress, self.before = self.before - self.cost(), self.cost()
        if self.distance() < 0.03 and abs(self.goal[2] - self.block[2]) < 0.1:
            self.reached += 1
            self.draw()
            self.before = self.cost() if self.refreshes else self.before

    def reward(self, action):
        gaps = [np.linalg.norm(hand - self.block[:2]) for hand in (self.left, self.right)]
        near = sum(np.exp(-gap / 0.5) for gap in gaps)
        return 2.0 * self.progress + 0.1 * self.sign * near - 0.01 * np.square(action).sum()

    def result(self, reward, _):
        return self.observe(), float(reward), False, self.steps >= self.limit, {"is_success": self.reached > 0}


class RL627TwoHandsOldGoal(TwoHands):
    refreshes = False


class RL622TwoHandsStayAway(TwoHands):
    sign = -1.0
