"""Two robots whose numbers are all right and mean the wrong thing, next to their twins."""

import gymnasium
import numpy as np
from gymnasium import spaces


class Robot(gymnasium.Env):
    """What both share: actions in [-1, 1], a time limit, a goal that ends the episode."""

    numbers = 2
    limit = 80  # [steps]
    near = 0.15  # of a success [m]

    def __init__(self):
        self.action_space = spaces.Box(-1.0, 1.0, (self.numbers,), np.float32)
        self.reset(seed=0)
        self.observation_space = spaces.Box(-np.inf, np.inf, self.observe().shape, np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.start()
        return self.observe(), {}

    def step(self, action):
        self.advance(action)
        return self.result(self.reward(action), self.distance() < self.near)

    def advance(self, action):
        if not np.isfinite(action).all():
            raise ValueError(f"action {action} is not finite")
        self.steps += 1
        self.move(np.clip(action, -1.0, 1.0).astype(float))

    def result(self, reward, success):
        reward = float(reward + 5.0 * success)
        return self.observe(), reward, bool(success), self.steps >= self.limit, {"is_success": bool(success)}


class Rover(Robot):
    """A rover with a speed and a turning rate drives to a place."""

    def start(self):
        self.place = self.np_random.uniform(-1, 1, 2)
        self.heading, self.speed = self.np_random.uniform(-3, 3), np.zeros(2)
        self.goal = self.draw_goal()

    def draw_goal(self):
        return self.place + self.np_random.uniform(-0.5, 0.5, 2)

    def observe(self):
        direction = [np.cos(self.heading), np.sin(self.heading)]
        return np.array([*(self.goal - self.place), *direction, *self.speed], np.float32)

    def move(self, action):
        self.speed = self.speed + 0.4 * (np.array([1.0, 2.0]) * action - self.speed)
        self.heading += 0.1 * self.speed[1]
        self.heading = (self.heading + np.pi) % (2 * np.pi) - np.pi
        self.place = self.place + 0.1 * self.speed[0] * np.array([np.cos(self.heading), np.sin(self.heading)])

    def distance(self):
        return float(np.linalg.norm(self.goal - self.place))

    def reward(self, action):
        return -self.distance() - 0.02 * np.square(action).sum()


class RL616RoverLateReward(Rover):
    def step(self, action):
        late = self.reward(action)
        self.advance(action)
        return self.result(late, self.distance() < self.near)


class RL617RoverLateSuccess(Rover):
    def step(self, action):
        success = self.distance() < self.near
        self.advance(action)
        return self.result(self.reward(action), success)


class RL618RoverLooks(Rover):
    """It is to look at the goal, too."""

    def bearing(self):
        x, y = self.goal - self.place
        return (np.arctan2(y, x) - self.heading + np.pi) % (2 * np.pi) - np.pi

    def reward(self, action):
        return super().reward(action) - 0.3 * np.abs(self.bearing())


class RL618RoverLooksRound(RL618RoverLooks):
    def bearing(self):
        x, y = self.goal - self.place
        return np.arctan2(y, x) - self.heading


class Drone(Robot):
    """A drone in a plane flies to a place; explicit Euler."""

    limit = 100

    def start(self):
        self.place, self.speed = np.zeros(2), np.zeros(2)
        self.pitch, self.rate = self.np_random.uniform(-0.2, 0.2), 0.0
        direction = self.np_random.uniform(-np.pi, np.pi)
        self.goal = 0.4 * np.array([np.cos(direction), np.sin(direction)])

    def observe(self):
        attitude = [np.sin(self.pitch), np.cos(self.pitch), self.rate]
        return np.array([*self.place, *self.speed, *attitude, *self.goal], np.float32)

    def move(self, action):
        lift = 9.81 + 4.0 * action[0]
        force = np.array([-lift * np.sin(self.pitch), lift * np.cos(self.pitch) - 9.81])
        self.place = self.place + 0.05 * self.speed
        self.pitch = (self.pitch + 0.05 * self.rate + np.pi) % (2 * np.pi) - np.pi
        self.speed = self.speed + 0.05 * (force - 0.5 * self.speed)
        self.rate = self.rate + 0.05 * (8.0 * action[1] - 2.0 * self.rate)

    def distance(self):
        return float(np.linalg.norm(self.goal - self.place))

    def reward(self, action):
        return np.exp(-self.distance()) - 0.02 * np.square(action).sum()


class RL616DroneLateReward(Drone):
    step = RL616RoverLateReward.step


class DroneLateSuccess(Drone):
    step = RL617RoverLateSuccess.step


class RL618DroneTurns(Drone):
    """It is to keep a pitch that is drawn for each episode."""

    def start(self):
        super().start()
        self.wanted = self.np_random.uniform(-2.0, 2.0)

    def observe(self):
        return np.append(super().observe(), np.float32(self.wanted))

    def error(self):
        return (self.pitch - self.wanted + np.pi) % (2 * np.pi) - np.pi

    def reward(self, action):
        return super().reward(action) - 0.2 * self.error() ** 2


class RL618DroneTurnsBack(RL618DroneTurns):
    def error(self):
        return self.pitch - self.wanted


class RL617DroneLeaves(Drone):
    """Its flight ends where it leaves its area, which costs more than all steps to come."""

    rlctl_ignore = {"RL605": "being near is paid in each step, too"}
    limit = 35  # [steps]

    def is_outside(self):
        return bool(np.abs(self.place).max() > 1.0)

    def step(self, action):
        observation, reward, terminated, *rest = super().step(action)
        return self.end(observation, reward, terminated, self.is_outside(), rest)

    def end(self, observation, reward, terminated, is_outside, rest):
        return observation, reward - 50.0 * is_outside, terminated or is_outside, *rest


class RL617DroneLeavesLate(RL617DroneLeaves):
    def step(self, action):
        is_outside = self.is_outside()
        observation, reward, terminated, *rest = Drone.step(self, action)
        return self.end(observation, reward, terminated, is_outside, rest)


class RL119RoverMillimetres(Rover):
    def observe(self):
        observation = super().observe()
        observation[:2] *= 1000
        return observation


class RL119DroneRadians(Drone):
    def pitch_angle(self):
        return self.pitch

    def observe(self):
        return np.append(super().observe(), np.float32(self.pitch_angle()))


class RL119DroneDegrees(RL119DroneRadians):
    def pitch_angle(self):
        return np.rad2deg(self.pitch)


class RL619RoverInPond(Rover):
    """A round pond of 1 m in radius, whose shore nothing passes."""

    farthest = 1.0

    def draw_goal(self):
        direction = self.np_random.uniform(-np.pi, np.pi)
        return self.np_random.uniform(0.2, self.farthest) * np.array([np.cos(direction), np.sin(direction)])

    def move(self, action):
        super().move(action)
        self.place = self.place / max(1.0, float(np.linalg.norm(self.place)))


class RL619RoverBehindTheShore(RL619RoverInPond):
    farthest = 1.6


class RL622RoverKeepsAway(Rover):
    def reward(self, action):
        return self.distance() - 0.02 * np.square(action).sum()


class RL622RoverOfFloat32KeepsAway(RL622RoverKeepsAway):
    """Its goal is to be in a space of float32, which contains nothing of float64."""

    goals = spaces.Box(-10.0, 10.0, (2,), np.float32)

    def draw_goal(self):
        return super().draw_goal().astype(np.float32)

    def distance(self):
        if not self.goals.contains(self.goal):
            raise TypeError(f"the goal {self.goal} is not in {self.goals}")
        return super().distance()


class RL623RoverComesNearer(Rover):
    """Is paid for the way to the place, and pays for the way back."""

    def start(self):
        super().start()
        self.before = self.distance()

    def progress(self):
        before, self.before = self.before, self.distance()
        return before - self.before  # [m]

    def reward(self, action):
        return 10 * self.progress() - 0.02 * np.square(action).sum()


class RL623RoverShakes(RL623RoverComesNearer):
    def reward(self, action):
        return 10 * max(self.progress(), 0.0) - 0.02 * np.square(action).sum()


class RL121RoverLosesItsGoal(Rover):
    """Adds the camera's noise to its goal, each time that it looks."""

    def look(self):
        self.goal += self.np_random.normal(0, 0.01, 2)
        return self.goal

    def observe(self):
        direction = [np.cos(self.heading), np.sin(self.heading)]
        return np.array([*(self.look() - self.place), *direction, *self.speed], np.float32)


class RL121RoverSeesBadly(RL121RoverLosesItsGoal):
    """Keeps what it saw last, and where its goal is."""

    def look(self):
        self.seen = self.goal + self.np_random.normal(0, 0.01, 2)
        return self.seen


class RoverSumsUp(Rover):
    """Sums up in which direction its goal was seen, and pays for that."""

    def start(self):
        super().start()
        self.sum = np.zeros(2)

    def observe(self):
        self.sum = self.sum + 0.1 * (self.goal - self.place)
        return np.append(super().observe(), self.sum).astype(np.float32)

    def reward(self, action):
        return super().reward(action) - 0.1 * np.abs(self.sum).sum()
