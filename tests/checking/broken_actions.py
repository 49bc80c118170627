"""Environments whose actions do nothing, too little or too much; and twins that only look so."""

import collections

import numpy as np
from broken_envs import Clean
from gymnasium import spaces


class OneAxis(Clean):
    """Success is a matter of the first number alone."""

    def info(self):
        return {"is_success": bool(abs(self.position[0]) < 0.1)}


class RL701DeadAction(OneAxis):
    def move(self, action):
        super().move(action * np.array([1, 0], np.float32))


class DeadActionOfGlobalDraws(RL701DeadAction):
    """Its start is another one after each reset, whatever the seed: the dead action shows all the same."""

    def start(self):
        self.position = np.random.uniform(-1, 1, 2).astype(np.float32)  # noqa: NPY002


class RL701NoAction(Clean):
    """A point that drifts, whatever is done."""

    def move(self, action):
        super().move(self.np_random.uniform(-1, 1, 2).astype(np.float32))


class RL701LateAction(OneAxis):
    """The second number acts only near the end: nothing is wrong with it."""

    def move(self, action):
        super().move(action * np.array([1, self.steps > 40], np.float32))


class RL701HiddenAction(OneAxis):
    """The second number moves something that is not observed, and that is rewarded: it acts."""

    def start(self):
        super().start()
        self.heat = 0.0

    def move(self, action):
        self.heat = 0.9 * self.heat + float(action[1])
        super().move(action * np.array([1, 0], np.float32))

    def reward(self):
        return super().reward() - 0.01 * abs(self.heat)


class RL701CostlyAction(OneAxis):
    """The second number costs, and moves nothing."""

    def move(self, action):
        self.cost = 0.1 * float(action[1]) ** 2
        super().move(action * np.array([1, 0], np.float32))

    def reward(self):
        return super().reward() - self.cost


class RL705ChangesAction(Clean):
    def step(self, action):
        action *= 0.5
        return super().step(action)


class RL705ChangesPartOfAction(Clean):
    """Takes a part out of the action, a dictionary."""

    rlctl_ignore = {"RL109": "this is about its actions"}

    def __init__(self):
        super().__init__()
        self.action_space = spaces.Dict({"push": self.action_space})

    def step(self, action):
        return super().step(action.pop("push"))


class Watched(RL701CostlyAction):
    """Actions are rewarded, and change nothing else: a series that is watched."""

    def move(self, action):
        super().move(action)
        self.cost = float((action * self.position).sum())
        self.position = self.np_random.uniform(-1, 1, 2).astype(np.float32)


class RL701CopiedAction(OneAxis):
    """The last action is observed; the second number does nothing else."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Box(-5.0, 5.0, (4,), np.float32)

    def start(self):
        super().start()
        self.last = np.zeros(2, np.float32)

    def move(self, action):
        self.last = action
        super().move(action * np.array([1, 0], np.float32))

    def observe(self):
        return np.concatenate([self.position, self.last])


class RL701OnlyCosts(RL701CostlyAction):
    """Actions cost, and move nothing."""

    def move(self, action):
        self.cost = 0.1 * float(np.square(action).sum())
        self.position = self.np_random.uniform(-1, 1, 2).astype(np.float32)


class RL701OnlyCopies(RL701CopiedAction):
    """Actions are observed, and do nothing else."""

    def move(self, action):
        self.last = action
        self.position = self.np_random.uniform(-1, 1, 2).astype(np.float32)


class RL701DeadChoice(Clean):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Discrete(4)

    def move(self, action):
        super().move(self.np_random.uniform(-1, 1, 2).astype(np.float32))


class RL701Choice(RL701DeadChoice):
    """Four directions: nothing is wrong with it."""

    def step(self, action):
        self.chosen = int(action)
        return super().step(np.zeros(2, np.float32))

    def move(self, action):
        way = [(1, 0), (-1, 0), (0, 1), (0, -1)][self.chosen]
        Clean.move(self, np.array(way, np.float32))


class DeadLater(RL701DeadAction):
    """Its first episode is not like the others: a dead action shows all the same."""

    first = True

    def start(self):
        super().start()
        self.position += np.float32(1e-6 * self.first)
        self.first = False


class RL701Switch(Clean):
    """The second number opens or closes: nothing is wrong with it."""

    def move(self, action):
        super().move(np.array([action[0], np.sign(action[1])], np.float32))


class Valves(Clean):
    """Actions open and close two valves, which are closed at first."""

    def start(self):
        super().start()
        self.openings = np.zeros(2, np.float32)

    def move(self, action):
        self.openings = np.clip(self.openings + 0.1 * action, 0.0, 1.0)
        super().move(0.5 - self.openings)


class WaitsAndKeepsATrace(Clean):
    """Each action acts four steps later, and a trace of the last episode is observed: the reward is not late."""

    last = np.zeros(2, np.float32)

    def start(self):
        super().start()
        self.trace = np.float32(1e-5) * self.last
        self.waiting = collections.deque([np.zeros(2, np.float32)] * 4)

    def move(self, action):
        self.waiting.append(action.astype(np.float32))
        super().move(self.waiting.popleft())
        self.last = self.position.copy()

    def observe(self):
        return self.position + self.trace


class GrasperFarAway(RL701Switch):
    """It closes only where there is something, and that is far away."""

    def move(self, action):
        grip = action[1]
        if grip > 0 and np.linalg.norm(self.position) > 100:
            self.position[:] = 0
        Clean.move(self, np.array([action[0], 0], np.float32))


class ReturnsNothing(Clean):
    def step(self, action):
        super().step(action)


class Trader(OneAxis):
    """It holds a good, or not, and is paid when it sells; the price is watched. To hold nothing is a choice as well."""

    def __init__(self):
        super().__init__()
        self.action_space = spaces.Discrete(2)

    def start(self):
        super().start()
        self.holds = False

    def move(self, action):
        price = self.position[0]
        self.paid = 0.0
        if action != self.holds:
            self.paid = price - self.bought if self.holds else -0.2
            self.holds, self.bought = bool(action), price
        self.position = self.np_random.uniform(-1, 1, 2).astype(np.float32)

    def reward(self):
        return float(self.paid)
