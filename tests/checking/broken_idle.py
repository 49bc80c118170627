"""A skiff whose reset or whose clock decides less than it seems, next to its twins."""

from collections import deque

import numpy as np
from robots import Robot

MASS = 1.0


class Skiff(Robot):
    """It passes three gates in a current, and gusts turn it now and then."""

    rlctl_ignore = {"RL611": "chance does not take it through three gates"}
    every = 25  # [steps] from gust to gust
    course = None

    def size(self):
        return 9

    def start(self):
        rng = self.np_random
        self.place, self.heading, self.speed = rng.uniform(-1, 1, 2), rng.uniform(-3, 3), np.zeros(2)
        self.current = rng.uniform(-0.02, 0.02, 2)
        self.load()
        self.gates = self.place + self.draw_course()
        self.gate = 0
        self.look()

    def load(self):
        self.mass = MASS * self.np_random.uniform(0.8, 1.2)

    def draw_course(self):
        return np.cumsum(self.np_random.uniform(-0.6, 0.6, (3, 2)), axis=0)

    def look(self):
        c, s = np.cos(self.heading), np.sin(self.heading)
        self.way = np.array([[c, s], [-s, c]]) @ (self.gates[self.gate] - self.place)

    def drift(self):
        return self.current

    def advance(self, action):
        self.speed += 0.4 * (np.array([action.sum() / 2, action[0] - action[1]]) - self.speed) / self.mass
        self.heading += 0.3 * self.speed[1]
        along = np.array([np.cos(self.heading), np.sin(self.heading)])
        self.place = self.place + 0.1 * self.speed[0] * along + self.drift()
        if self.steps % self.every == 0:
            self.heading += self.np_random.normal(0, 0.3)

    def move(self, action):
        self.advance(action)
        if self.gate < 2 and self.distance() < 0.2:
            self.gate += 1
        self.look()

    def observe(self):
        rest = [np.cos(self.heading), np.sin(self.heading), *self.speed, *self.current, float(self.gate)]
        return np.array([*self.way, *rest], np.float32)

    def distance(self):
        return float(np.linalg.norm(self.gates[self.gate] - self.place))

    def is_success(self):
        return self.gate == 2 and self.distance() < 0.2

    def reward(self):
        return -self.distance()


class RL815SkiffLooksOnce(Skiff):
    rlctl_ignore = {"RL611": "a consequence", "RL114": "a consequence", "RL623": "the current moves it"}

    def move(self, action):
        self.advance(action)
        if self.gate < 2 and self.distance() < 0.2:
            self.gate += 1


class SkiffKnowsItsStart(Skiff):
    """It sees where the first gate was when it started, which its name says."""

    def start(self):
        super().start()
        self.start_way = self.gates[0] - self.place

    def observe(self):
        rest = [np.cos(self.heading), np.sin(self.heading), *self.speed, *self.start_way, float(self.gate)]
        return np.array([*self.way, *rest], np.float32)


class RL638SkiffShowsItsFirstGate(Skiff):
    def look(self):
        c, s = np.cos(self.heading), np.sin(self.heading)
        self.way = np.array([[c, s], [-s, c]]) @ (self.gates[0] - self.place)


class SkiffKnowsItsCourse(Skiff):
    """What it observes of its gates is in the length of its course, from the first gate to the last."""

    def look(self):
        super().look()
        self.way = self.way / (0.1 + np.linalg.norm(self.gates[-1] - self.gates[0]))


class SkiffTellsOfGates(Skiff):
    """A line of it is a condition of a call."""

    def tell(self):
        self.told = self.gate

    def move(self, action):
        super().move(action[()])
        self.gate > 0 and self.tell()


class RL842SkiffWithoutCurrent(Skiff):
    def drift(self):
        return 0.0


class SkiffGustsTooLate(Skiff):
    every = 90


class SkiffGustsLate(Skiff):
    """Gusts come within an episode, and after those that the check plays at random."""

    every = 55


class RL817SkiffGetsHeavier(Skiff):
    mass = MASS

    def load(self):
        self.mass *= self.np_random.uniform(0.8, 1.2)


class SkiffOfOneSeed(Skiff):
    def reset(self, *, seed=None, options=None):
        super().reset(seed=4)
        self.start()
        return self.observe(), {}


class SkiffOnOneCourse(Skiff):
    def start(self):
        super().start()
        if self.course is None:
            self.course = self.draw_course()
        self.gates = self.place + self.course
        self.look()


class SkiffByItsFixes(Skiff):
    """It goes by the newest of several fixes."""

    def start(self):
        self.fixes = deque(maxlen=8)
        super().start()
        self.fixes.extend([self.place] * 8)
        self.look()

    def advance(self, action):
        super().advance(action)
        self.fixes.append(self.place.copy())

    def look(self):
        c, s = np.cos(self.heading), np.sin(self.heading)
        place = self.fixes[-1] if self.fixes else self.place
        self.way = np.array([[c, s], [-s, c]]) @ (self.gates[self.gate] - place)


class SkiffByItsOldestFix(SkiffByItsFixes):
    def look(self):
        c, s = np.cos(self.heading), np.sin(self.heading)
        if self.fixes:
            self.way = np.array([[c, s], [-s, c]]) @ (self.gates[self.gate] - self.fixes[0])
