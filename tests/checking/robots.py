"""Small robots without a mistake, from which `broken_robots.py` derives robots with one mistake each."""

from pathlib import Path

import gymnasium
import numpy as np
import pybullet as p
from gymnasium import spaces

HERE = Path(__file__).parent


class Robot(gymnasium.Env):
    """What all of them share: actions in [-1, 1], a time limit, and the order of a step."""

    joints = 2
    limit = 60  # [steps]
    penalty = 5.0

    def __init__(self):
        self.action_space = spaces.Box(-1.0, 1.0, (self.joints,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.size(),), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.start()
        return self.observe(), {}

    def step(self, action):
        if not np.isfinite(action).all():
            raise ValueError(f"action {action} is not finite")
        self.steps += 1
        self.move(np.clip(action, -1.0, 1.0).astype(float))
        success, failed = self.is_success(), self.has_failed()
        reward = self.reward() + 2.0 * success - self.penalty * failed
        return self.observe(), float(reward), success or failed, self.steps >= self.limit, self.info(success)

    def info(self, success):
        return {"is_success": success}

    def has_failed(self):
        return False


class Boat(Robot):
    """A boat with two propellers goes to a buoy."""

    def start(self):
        self.place = self.np_random.uniform(-1, 1, 2)
        self.heading, self.speed = self.np_random.uniform(-3, 3), np.zeros(2)
        self.buoy = self.draw_buoy()

    def draw_buoy(self):
        return self.place + self.np_random.uniform(-0.6, 0.6, 2)

    def size(self):
        return len(self.observed())

    def observed(self):
        return ("ahead", "left", "sin heading", "cos heading", "speed", "turn")

    def observe(self):
        c, s = np.cos(self.heading), np.sin(self.heading)
        x, y = self.buoy - self.place
        return np.array([c * x + s * y, c * y - s * x, s, c, *self.speed], np.float32)

    def move(self, action):
        self.speed += 0.4 * (np.array([action.sum() / 2, action[0] - action[1]]) - self.speed)
        self.heading += 0.3 * self.speed[1]
        self.place = self.place + 0.1 * self.speed[0] * np.array([np.cos(self.heading), np.sin(self.heading)])

    def distance(self):
        return float(np.linalg.norm(self.buoy - self.place))

    def is_success(self):
        return self.distance() < 0.2

    def reward(self):
        return -self.distance()


class Tank(Robot):
    """A heater keeps the water of a tank at a temperature that is drawn for each episode."""

    joints = 1
    penalty = 100.0  # more than what all later steps can cost

    def start(self):
        self.temperature = self.np_random.uniform(0.0, 0.5)
        self.wanted = self.np_random.uniform(0.3, 0.9)
        self.rate = 0.0

    def size(self):
        return 3

    def observe(self):
        return np.array([self.temperature, self.rate, self.wanted], np.float32)

    def move(self, action):
        self.rate = 0.1 * action[0] - 0.02 * self.temperature
        self.temperature += self.rate

    def is_success(self):
        return False

    def has_failed(self):
        return bool(abs(self.temperature) > 1.5)

    def reward(self):
        return -abs(self.temperature - self.wanted)

    def info(self, success):
        return {"is_success": abs(self.temperature - self.wanted) < 0.05}


class Simulated(Robot):
    """A robot in PyBullet, reset by a state that was saved right after loading."""

    rlctl_ignore = {"RL303": "contacts are not reset to the last bit"}
    joints = 3
    home = np.array([0.3, -0.5, 0.9])
    limit = 40

    def __init__(self):
        super().__init__()
        self.client = p.connect(p.DIRECT)
        p.setGravity(0, 0, -9.81, physicsClientId=self.client)
        p.setTimeStep(1 / 120, physicsClientId=self.client)
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[5, 5, 0.5], physicsClientId=self.client)
        self.floor = p.createMultiBody(0.0, shape, basePosition=[0, 0, -0.5], physicsClientId=self.client)
        self.load()
        self.state = p.saveState(physicsClientId=self.client)

    def size(self):
        return 2 * self.joints

    def start(self):
        p.restoreState(self.state, physicsClientId=self.client)
        positions = self.home + self.np_random.uniform(-0.02, 0.02, self.joints)
        for joint, position in enumerate(positions):
            p.resetJointState(self.robot, joint, position, physicsClientId=self.client)
        self.drive(positions)

    def target(self, action):
        return self.home + 0.4 * action

    def drive(self, targets):
        p.setJointMotorControlArray(
            self.robot, range(3), p.POSITION_CONTROL, list(targets), forces=[30.0] * 3, physicsClientId=self.client
        )

    def move(self, action):
        self.drive(self.target(action))
        for _ in range(4):
            p.stepSimulation(physicsClientId=self.client)

    def observe(self):
        states = p.getJointStates(self.robot, range(3), physicsClientId=self.client)
        return np.array([state[0] for state in states] + [state[1] for state in states], np.float32)

    def touches(self, link):
        return len(p.getContactPoints(self.robot, self.floor, link, -1, physicsClientId=self.client)) > 0


class Arm(Simulated):
    """An arm of three joints holds its hand up."""

    height = 0.77  # of a success [m]; it is 0.75 at home

    def load(self):
        self.robot = p.loadURDF(str(HERE / "arm.urdf"), useFixedBase=True, physicsClientId=self.client)

    def hand(self):
        return p.getLinkState(self.robot, 3, computeForwardKinematics=True, physicsClientId=self.client)

    def is_success(self):
        return False

    def reward(self):
        return self.hand()[4][2] - 0.8

    def info(self, success):
        return {"is_success": self.hand()[4][2] > self.height}


class Crawler(Simulated):
    """A box with two feet and a tail crawls forward."""

    home = np.array([0.3, 0.6, -0.4])

    def size(self):
        return 2 * self.joints + 3

    def load(self):
        place = [0, 0, 0.12]
        self.robot = p.loadURDF(str(HERE / "crawler.urdf"), place, physicsClientId=self.client)

    def angles(self):
        _, quaternion = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        return p.getEulerFromQuaternion(quaternion)

    def observe(self):
        return np.concatenate([super().observe(), self.angles()]).astype(np.float32)

    def forward(self):
        return p.getBaseVelocity(self.robot, physicsClientId=self.client)[0][0]

    def is_success(self):
        return False

    def reward(self):
        return self.forward()

    def info(self, success):
        return {"is_success": self.forward() > 0.0 and not self.has_failed()}


class Pusher(Arm):
    """A crank that turns about the vertical pushes a cube; how fast the cube slides is observed in the world's frame,
    as is where its crank is."""

    home = np.array([0.0, 0.0, 0.0])
    placed = (0.25, 0.09, 0.03)  # of the cube, beside the crank [m]

    def size(self):
        return 2 * self.joints + 6

    def load(self):
        p.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=self.client)
        self.robot = p.loadURDF(str(HERE / "crank.urdf"), useFixedBase=True, physicsClientId=self.client)
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.03] * 3, physicsClientId=self.client)
        self.cube = p.createMultiBody(0.1, shape, basePosition=self.placed, physicsClientId=self.client)

    def hand(self):
        return p.getLinkState(self.robot, 2, computeForwardKinematics=True, physicsClientId=self.client)

    def start(self):
        super().start()
        self.put_cube(np.add(self.placed, [*self.np_random.uniform(-0.02, 0.02, 2), 0.0]))

    def put_cube(self, place):
        for z in (9.0, place[2]):  # far away first, which forgets the contacts of the last episode
            p.resetBasePositionAndOrientation(self.cube, [*place[:2], z], [0, 0, 0, 1], physicsClientId=self.client)
            p.performCollisionDetection(physicsClientId=self.client)

    def observe(self):
        place, _ = p.getBasePositionAndOrientation(self.cube, physicsClientId=self.client)
        velocity, _ = p.getBaseVelocity(self.cube, physicsClientId=self.client)
        return np.concatenate([super().observe(), place, velocity]).astype(np.float32)

    def reward(self):
        velocity, _ = p.getBaseVelocity(self.cube, physicsClientId=self.client)
        return velocity[1] - 0.1

    def info(self, success):
        return {"is_success": p.getBasePositionAndOrientation(self.cube, physicsClientId=self.client)[0][1] > 0.14}
