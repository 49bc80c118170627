"""A puck whose reward rises with a distance, pays little for success, counts a number with its sign, or compares a
command with something that cannot meet it, or always does; each written in several ways, next to twins."""

import math

import gymnasium as gym
import numpy as np
from gymnasium import spaces

DT, LONGEST = 0.05, 200
WEIGHTS = {"approach": 0.7, "straight": -0.5, "effort": -0.01}


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def nearness(distance, scale):
    return math.exp(-scale * distance)


def squared_distance(one, two):
    return float(np.sum((one - two) ** 2))


class Puck(gym.Env):
    """It is pushed to a goal on a plane, and told how fast to go and to turn."""

    rlctl_ignore = {"RL609": "success is told where it is paid"}

    def __init__(self):
        self.action_space = spaces.Box(-1, 1, (3,), np.float32)
        self.observation_space = spaces.Box(-50, 50, (12,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        draw = self.np_random.uniform
        self.state = {"place": draw(-0.5, 0.5, 2), "speed": draw(-0.1, 0.1, 2), "yaw": draw(-0.3, 0.3), "turning": 0.0}
        self.goal, self.block = draw(-1, 1, 2), draw(-1, 1, 2)
        self.cmd = draw([-0.6, -1.0], [0.6, 1.0])
        self.roll, self.roll_rate, self.mean_turn = 0.0, 0.0, 0.0
        self.steps = 0
        self.before = self.gap()
        return self.observe(), {}

    def gap(self):
        return float(np.linalg.norm(self.goal - self.state["place"]))

    def observe(self):
        state = self.state
        seen = [*state["place"], *state["speed"], math.sin(state["yaw"]), math.cos(state["yaw"]), state["turning"]]
        return np.array([*seen, *(self.goal - state["place"]), *self.cmd, self.roll], np.float32)

    def move(self, action):
        state = self.state
        state["speed"] = state["speed"] + DT * (3 * action[:2] - 1.5 * state["speed"])
        state["place"] = state["place"] + DT * state["speed"]
        state["turning"] += DT * (4 * action[2] - 2 * state["turning"])
        state["yaw"] = wrap(state["yaw"] + DT * state["turning"])
        self.roll_rate += DT * (2 * action[1] - 8 * self.roll - self.roll_rate)
        self.roll += DT * self.roll_rate

    def step(self, action):
        action = np.clip(np.nan_to_num(np.asarray(action, float)), -1, 1)
        self.move(action)
        self.steps += 1
        reward = self.pay(action)
        self.before = self.gap()
        return self.observe(), float(reward), False, self.steps >= LONGEST, {"is_success": self.gap() < 0.1}

    def pay(self, action):
        dx, dy = self.goal - self.state["place"]
        return 1 / (1 + np.hypot(dx, dy)) - 0.01 * np.sum(action**2)


class RL622PuckFlees(Puck):
    def pay(self, action):
        dx, dy = self.goal - self.state["place"]
        return 2 - 1 / (1 + np.hypot(dx, dy)) - 0.01 * np.sum(action**2)


class PuckReaches(Puck):
    def pay(self, action):
        to_block = self.block - self.state["place"]
        reach = math.sqrt(to_block @ to_block)
        terms = {"approach": self.near(reach), "effort": float(np.sum(np.square(action)))}
        paid = 0.0
        for key in terms:
            paid += WEIGHTS[key] * terms[key]
        return paid

    def near(self, reach):
        return nearness(reach, 3.0)


class PuckShuns(PuckReaches):
    def near(self, reach):
        return 1 - nearness(reach, 3.0)


class PuckHurries(Puck):
    def pay(self, action):
        distance = self.gap()
        return 8 * (self.before - distance) - 0.3 * np.log(0.05 + distance)


class PuckTurnsBack(Puck):
    """Its progress is right."""

    def pay(self, action):
        distance = self.gap()
        return 8 * (self.before - distance) + 0.3 * np.log(0.05 + distance)


class PuckSquares(Puck):
    sign = -0.2

    def pay(self, action):
        return self.sign * squared_distance(self.goal, self.state["place"])


class PuckSquaresUp(PuckSquares):
    sign = 0.2


class PuckOrbits(Puck):
    """It keeps away from its goal, but not too far: nothing is wrong with that."""

    def pay(self, action):
        return -abs(np.linalg.norm(self.goal - self.state["place"]) - 0.4)


class PuckIsShaped(Puck):
    """Its shaping is discounted, so that it rises a little with a distance that stays."""

    def reset(self, **given):
        observation = super().reset(**given)
        self.last_potential = self.potential()
        return observation

    def potential(self):
        return -np.linalg.norm(self.goal - self.state["place"])

    def pay(self, action):
        new = self.potential()
        shaping, self.last_potential = 0.99 * new - self.last_potential, new
        return 10 * shaping


class PuckEnds(Puck):
    bonus = 3.0

    def pay(self, action):
        self.closed = action[2] > 0.5
        shaped = 1.5 * np.exp(-3 * self.gap()) + 0.5 * self.closed
        return np.where(self.succeeds(), self.bonus, shaped)

    def succeeds(self):
        return bool(self.gap() < 0.1 and not self.closed)

    def step(self, action):
        observation, reward, terminated, truncated, _ = super().step(action)
        return observation, reward, terminated, truncated, {"is_success": self.succeeds()}


class RL605PuckHolds(PuckEnds):
    bonus = 1.0


class PuckReturns(Puck):
    bonus = 200.0

    def pay_for(self, done):
        if done:
            return self.bonus
        paid = 1.0 - np.tanh(2 * self.gap())
        return paid - 0.01 * np.linalg.norm(self.state["speed"])

    def step(self, action):
        self.move(np.clip(np.nan_to_num(np.asarray(action, float)), -1, 1))
        self.steps += 1
        done = self.gap() < 0.08
        return self.observe(), float(self.pay_for(done)), done, self.steps >= LONGEST, {"is_success": done}


class PuckReturnsLittle(PuckReturns):
    bonus = 0.5


class PuckIsLevel(Puck):
    def pay(self, action):
        reward = 1 - self.gap()
        reward -= 0.4 * abs(self.roll)
        return reward


class RL630PuckLeans(Puck):
    def pay(self, action):
        reward = 1 - self.gap()
        reward -= 0.4 * self.roll
        return reward


class PuckWearsBothSides(Puck):
    def pay(self, action):
        uneven = 0.2 * abs(action[0] - action[1])
        return 1 - self.gap() - uneven


class PuckWearsOneSide(Puck):
    def pay(self, action):
        uneven = 0.2 * (action[0] - action[1])
        return 1 - self.gap() - uneven


class PuckIsStraight(Puck):
    def pay(self, action):
        terms = {
            "approach": self.state["speed"][0],
            "straight": self.error() ** 2,
            "effort": self.state["turning"] ** 2,
        }
        return sum(WEIGHTS[key] * terms[key] for key in terms)

    def error(self):
        return wrap(self.state["yaw"])


class PuckTurnsLeft(PuckIsStraight):
    def pay(self, action):
        terms = {"approach": self.state["speed"][0], "straight": self.error(), "effort": self.state["turning"] ** 2}
        return sum(WEIGHTS[key] * terms[key] for key in terms)


class PuckBacksUp(Puck):
    """It is told to go backwards: the sign is meant."""

    def pay(self, action):
        return -self.state["speed"][0]


class PuckIsAsFast(Puck):
    def pay(self, action):
        return -abs(np.linalg.norm(self.state["speed"]) - abs(self.cmd[0])) - 0.1 * self.gap()


class PuckIsAsFastThatWay(PuckIsAsFast):
    def pay(self, action):
        return super().pay(action) + 0.2 * self.way() * self.state["speed"][0]

    def way(self):
        return np.sign(self.cmd[0])


class PuckFollows(Puck):
    def pay(self, action):
        errors = {"ahead": self.ahead() - self.cmd[0], "turn": self.state["turning"] - self.cmd[1]}
        return -sum(abs(error) for error in errors.values())

    def ahead(self):
        return self.state["speed"][0]


class RL633PuckOnlySpeeds(PuckFollows):
    def ahead(self):
        vx, vy = self.state["speed"]
        return np.sqrt(vx**2 + vy**2)


class PuckTurnsAsTold(Puck):
    def pay(self, action):
        self.mean_turn = 0.8 * self.mean_turn + 0.2 * self.turning()
        command = self.cmd[1]
        return 1 - np.tanh(np.abs(command - self.mean_turn))

    def turning(self):
        return self.state["turning"]


class PuckTurnsEitherWay(PuckTurnsAsTold):
    def turning(self):
        return abs(self.state["turning"])


class PuckIsTolerant(Puck):
    width = 0.3

    def pay(self, action):
        error = self.state["speed"][0] - self.cmd[0]
        turn_error = self.state["turning"] - self.cmd[1]
        return 1 / (1 + (error / self.width) ** 2) + np.exp(-(turn_error**2)) - 0.01 * np.sum(action**2)


class RL632PuckIsAlwaysRight(PuckIsTolerant):
    width = 30.0


class PuckHasKernels(Puck):
    sigma = 0.25

    def pay(self, action):
        turn = np.exp(-((self.cmd[1] - self.state["turning"]) ** 2) / (2 * self.sigma**2))
        return turn + np.exp(-((self.cmd[0] - self.state["speed"][0]) ** 2) / 0.25)


class PuckHasWideKernels(PuckHasKernels):
    sigma = 25.0
