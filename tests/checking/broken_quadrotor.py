"""A quadrotor in NumPy: its state is a tuple of unlike arrays, its reward terms are in info without their weights."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

STEP_HZ = 50
INNER = 4
G = 9.81
WEIGHTS = {"vel": 1.0, "yaw": 0.5, "upright": 0.2, "rates": -0.05, "jerk": -0.02}


def quat_mul(a, b):
    w1, x1, y1, z1 = a
    w2, x2, y2, z2 = b
    w, x = w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2, w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2
    return np.array([w, x, w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2, w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2])


def to_mat(q):
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


class Quadrotor(gym.Env):
    """Follows a velocity in its own frame, and a turn rate."""

    metadata = {"render_modes": [], "render_fps": STEP_HZ}
    rlctl_ignore = {"RL611": "random thrusts do not follow a speed"}
    cmd_period = 3.0

    def __init__(self):
        self.action_space = spaces.Box(-1, 1, (4,), np.float32)
        sizes = {"imu": 6, "vel": 3, "command": 4, "prev": 4}
        boxes = {name: spaces.Box(-np.inf, np.inf, (size,), np.float64) for name, size in sizes.items()}
        self.observation_space = spaces.Dict(boxes)

    def draw_command(self):
        r = self.np_random
        self.wanted = r.uniform([-1, -1, -0.5, -1], [1, 1, 0.5, 1])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        r = self.np_random
        yaw = r.uniform(-np.pi, np.pi)
        q = quat_mul(np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]), np.array([1, *r.uniform(-0.05, 0.05, 2), 0]))
        place = r.uniform([-1, -1, 4], [1, 1, 6])
        velocity, rates = r.uniform(-0.3, 0.3, 3), r.uniform(-0.1, 0.1, 3)
        self.x = (place, velocity, q / np.linalg.norm(q), rates)
        self.clear()
        self.t = 0.0
        self.n = 0
        self.draw_command()
        return self.obs(), {}

    def clear(self):
        self.prev = np.zeros(4)
        self.rotor = np.zeros(4)

    def dt_inner(self):
        return 1 / STEP_HZ / INNER

    def dt_att(self):
        return self.dt_inner()

    def physics(self, u):
        h = self.dt_inner()
        p, v, q, w = self.x
        for _ in range(INNER):
            self.rotor = self.rotor + h / 0.03 * (u - self.rotor)
            thrust = G * (1 + 0.6 * self.rotor[0])
            torque = np.array([8, 8, 3]) * self.rotor[1:]
            R = to_mat(q)
            v = v + h * (R @ [0, 0, thrust] - [0, 0, G] - 0.3 * v)
            w = w + h * (torque - 1.5 * w)
            q = q + 0.5 * self.dt_att() * quat_mul(q, np.array([0, *w]))
            q = q / np.linalg.norm(q)
            p = p + h * v
        self.x = (p, v, q, w)

    def body_vel(self):
        _p, v, q, _w = self.x
        return to_mat(q).T @ v

    def up(self):
        return to_mat(self.x[2]).T @ [0, 0, 1.0]

    def yaw_target(self):
        return self.wanted[3]

    def components(self, a):
        v, w = self.body_vel(), self.x[3]
        return {
            "vel": np.exp(-np.sum((v - self.wanted[:3]) ** 2) / 0.5),
            "yaw": np.exp(-((w[2] - self.yaw_target()) ** 2) / 0.3),
            "upright": max(self.up()[2], 0.0),
            "rates": self.rates(w),
            "jerk": np.sum((a - self.prev) ** 2),
        }

    def rates(self, w):
        return np.sum(w[:2] ** 2)

    def apply(self, a):
        self.physics(a)

    def step(self, action):
        if not np.isfinite(action).all():
            raise ValueError("the action is not finite")
        a = np.clip(np.asarray(action, float), -1, 1)
        self.apply(a)
        self.n += 1
        self.t += 1 / STEP_HZ
        c = self.components(a)
        reward = float(sum(WEIGHTS[k] * x for k, x in c.items()))
        self.prev = a
        term = bool(self.up()[2] < 0.2 or self.x[0][2] < 0.1)
        if term:
            reward -= 5
        if self.n % int(self.cmd_period * STEP_HZ) == 0:
            self.draw_command()
        ok = bool(np.linalg.norm(self.body_vel() - self.wanted[:3]) < 0.2)
        info = {"reward_parts": {k: float(x) for k, x in c.items()}, "is_success": ok}
        return self.obs(), reward, term, self.n >= 400, info

    def obs(self):
        imu = np.concatenate([self.up(), self.x[3]])
        return {"imu": imu, "vel": self.body_vel(), "command": self.wanted.copy(), "prev": self.prev.copy()}


class RL115QuadrotorActsLate(Quadrotor):
    """Its rotors get the action before, which the observation has."""

    def apply(self, a):
        self.physics(self.prev)


class QuadrotorWithLatency(RL115QuadrotorActsLate):
    """The same, on purpose."""

    latency = 1  # [steps]


class RL124QuadrotorWrongWay(Quadrotor):
    def body_vel(self):
        return to_mat(self.x[2]) @ self.x[1]


class RL616QuadrotorLateReward(Quadrotor):
    def step(self, action):
        late = self.components(np.clip(action, -1, 1))
        observation, _, term, *rest, info = super().step(action)
        reward = float(sum(WEIGHTS[k] * x for k, x in late.items())) - 5 * term
        return observation, reward, term, *rest, {**info, "reward_parts": {k: float(x) for k, x in late.items()}}


class RL630QuadrotorSignedRates(Quadrotor):
    def rates(self, w):
        return np.sum(w[:2])


class RL632QuadrotorOtherElement(Quadrotor):
    def yaw_target(self):
        return self.wanted[2]


class RL832QuadrotorTurnsFast(Quadrotor):
    def dt_att(self):
        return 1 / STEP_HZ
