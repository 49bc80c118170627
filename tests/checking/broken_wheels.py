"""A cart in PyBullet: single numbers of info are its reward terms, its sensors have noise, its wishes are numbers."""

import gymnasium as gym
import numpy as np
import pybullet as p
from gymnasium import spaces

SUB = 10
DT = SUB / 240


class Wheels(gym.Env):
    """A cart on four wheels that follows a speed and a turn rate."""

    metadata = {"render_modes": []}
    rlctl_ignore = {"RL110": "it never tilts", "RL611": "random wheels do not follow a speed"}
    top_speed = 12.0
    turn_limit = 1.0

    def __init__(self):
        self.cid = p.connect(p.DIRECT)
        self.action_space = spaces.Box(-1, 1, (4,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (3 + 3 + 3 + 4 + 2 + 4 + 1,), np.float32)

    def make(self):
        c = self.cid
        p.resetSimulation(physicsClientId=c)
        p.setGravity(0, 0, -9.81, physicsClientId=c)
        ground = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=c)
        self.floor = p.createMultiBody(0, ground, physicsClientId=c)
        body = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.2, 0.12, 0.04], physicsClientId=c)
        wheel = p.createCollisionShape(p.GEOM_SPHERE, radius=0.06, physicsClientId=c)
        pos = [[0.15, 0.15, -0.03], [0.15, -0.15, -0.03], [-0.15, 0.15, -0.03], [-0.15, -0.15, -0.03]]
        self.car = p.createMultiBody(
            4.0,
            body,
            -1,
            [0, 0, 0.1],
            [0, 0, 0, 1],
            linkMasses=[0.3] * 4,
            linkCollisionShapeIndices=[wheel] * 4,
            linkVisualShapeIndices=[-1] * 4,
            linkPositions=pos,
            linkOrientations=[[0, 0, 0, 1]] * 4,
            linkInertialFramePositions=[[0, 0, 0]] * 4,
            linkInertialFrameOrientations=[[0, 0, 0, 1]] * 4,
            linkParentIndices=[0] * 4,
            linkJointTypes=[p.JOINT_REVOLUTE] * 4,
            linkJointAxis=[[0, 1, 0]] * 4,
            physicsClientId=c,
        )
        for j in range(4):
            p.changeDynamics(self.car, j, lateralFriction=0.8, physicsClientId=c)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.make()
        yaw = self.np_random.uniform(-np.pi, np.pi)
        turn = p.getQuaternionFromEuler([0, 0, yaw])
        p.resetBasePositionAndOrientation(self.car, [0, 0, 0.092], turn, physicsClientId=self.cid)
        self.count = 0
        self.memory = {"action": np.zeros(4), "speed": 0.0}
        self.wish()
        return self.look(), {}

    def wish(self):
        self.target_speed = self.np_random.uniform(-0.4, 0.6)
        self.target_turn = self.np_random.uniform(-1, 1)

    def frame(self):
        _, q = p.getBasePositionAndOrientation(self.car, physicsClientId=self.cid)
        return np.array(p.getMatrixFromQuaternion(q)).reshape(3, 3)

    def motion(self):
        R = self.frame()
        v, w = p.getBaseVelocity(self.car, physicsClientId=self.cid)
        return R.T @ np.array(v), R.T @ np.array(w), R.T @ np.array([0, 0, -1.0])

    def wheels(self):
        return np.array([s[1] for s in p.getJointStates(self.car, range(4), physicsClientId=self.cid)])

    def is_touched(self, contact):
        return contact[9] > 0.5  # [N]

    def touching(self):
        points = [p.getContactPoints(self.car, self.floor, k, -1, physicsClientId=self.cid) for k in range(4)]
        return np.array([float(any(map(self.is_touched, of_wheel))) for of_wheel in points])

    def drive(self, a):
        speeds = (self.top_speed * a).tolist()
        p.setJointMotorControlArray(
            self.car,
            range(4),
            p.VELOCITY_CONTROL,
            targetVelocities=speeds,
            forces=[1.5] * 4,
            physicsClientId=self.cid,
        )
        for _ in range(SUB):
            p.stepSimulation(physicsClientId=self.cid)

    def pay(self, a):
        v, w, _g = self.motion()
        acc = (v[0] - self.memory["speed"]) / DT
        self.memory["speed"] = v[0]
        return {
            "rew_speed": float(np.exp(-((v[0] - self.target_speed) ** 2) / 0.05)),
            "rew_turn": float(0.5 * np.exp(-((w[2] - self.turn_wish()) ** 2) / 0.2)),
            "rew_smooth": float(-0.05 * np.sum((a - self.memory["action"]) ** 2)),
            "rew_acc": float(-0.002 * acc**2),
            "rew_side": float(-0.5 * abs(v[1])),
        }

    def turn_wish(self):
        return self.target_turn

    def before(self, a):
        pass

    def step(self, action):
        if not np.isfinite(action).all():
            raise ValueError("the action is not finite")
        a = np.clip(np.asarray(action, float), -1, 1)
        self.before(a)
        self.drive(a)
        self.count += 1
        rew = self.pay(a)
        self.memory["action"] = a
        if self.count % 60 == 0:
            self.wish()
        v, w, g = self.motion()
        flipped = bool(g[2] > 0)
        ok = bool(abs(v[0] - self.target_speed) < 0.1 and abs(w[2] - self.target_turn) < 0.3)
        return self.look(), sum(rew.values()), flipped, self.count >= self.limit(), {**rew, "success": ok}

    def limit(self):
        return 240

    def look(self):
        v, w, g = self.motion()
        n = self.np_random.normal(size=6) * 0.01
        wishes, clock = [self.target_speed, self.target_turn], [self.count / self.limit()]
        parts = [v + n[:3], w + n[3:], g, 0.1 * self.wheels(), wishes, self.touching(), clock]
        return np.concatenate(parts).astype(np.float32)


class RL123WheelsInTheWorld(Wheels):
    def motion(self):
        return np.array(p.getBaseVelocity(self.car, physicsClientId=self.cid)[0]), *super().motion()[1:]


class RL124WheelsTurnedTwice(Wheels):
    rlctl_ignore = {**Wheels.rlctl_ignore, "RL123": "a velocity in no frame hides the heading, too"}

    def motion(self):
        v, *rest = super().motion()
        return self.frame().T @ v, *rest


class RL616WheelsLateReward(Wheels):
    def drive(self, a):
        self.late = self.pay(a)
        super().drive(a)

    def step(self, action):
        observation, _, *rest, info = super().step(action)
        return observation, sum(self.late.values()), *rest, {**info, **self.late}


class RL620WheelsActionWithItself(Wheels):
    def before(self, a):
        self.memory["action"] = a


class RL632WheelsOtherWish(Wheels):
    def turn_wish(self):
        return self.target_speed


class RL833WheelsDistance(Wheels):
    def is_touched(self, contact):
        return contact[8] > 0.5


class RL833WheelsOtherLink(Wheels):
    """Its wheels are links of the first body, not of the second one."""

    def touching(self):
        points = p.getContactPoints(self.car, self.floor, physicsClientId=self.cid)
        return np.isin(range(4), [contact[4] for contact in points]).astype(float)
