"""Spaces that learners treat otherwise than was meant."""

import numpy as np
from broken_envs import Clean, CleanDict
from gymnasium import spaces


class RL106Asymmetric(Clean):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(np.float32([-1.0, -0.5]), np.float32([1.0, 1.0]))

    def move(self, action):
        super().move(np.clip(action, self.action_space.low, self.action_space.high))


class MoreAndMoreAsymmetric(RL106Asymmetric):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(np.float32([-0.8, -0.1]), np.float32([1.0, 1.0]))


class RL106Thrust(RL106Asymmetric):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(np.float32([-1.0, 0.0]), np.float32([1.0, 1.0]))


class RL108Seen(Clean):
    """The point in a picture: nothing is wrong with it."""

    shape, dtype, low, high = (48, 48, 1), np.uint8, 0, 255

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Box(self.low, self.high, self.shape, self.dtype)

    def observe(self):
        picture = np.zeros((48, 48), self.dtype)
        x, y = np.clip((self.position + 5) * 4.6, 0, 45).astype(int)
        picture[x : x + 3, y : y + 3] = self.high
        return picture.reshape(self.shape)


class RL108FloatPicture(RL108Seen):
    dtype, high = np.float32, 1


class RL108TwoAxes(RL108Seen):
    shape = (48, 48)


class RL108FloatTable(RL108TwoAxes):
    """Rows of measurements: nothing is wrong with it."""

    dtype, high = np.float32, 1


class RL108Tiles(RL108Seen):
    """A board of 9 x 9 tiles: nothing is wrong with it."""

    shape = (9, 9)

    def observe(self):
        board = np.zeros((9, 9), np.uint8)
        board[0, :2] = (self.position + 5) * 25
        return board


class RL108Dark(RL108Seen):
    def observe(self):
        return super().observe() // 255


class RL109CountsFromOne(Clean):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Discrete(2, start=1)

    def step(self, action):
        return super().step(np.full(2, action - 1.5, np.float32))


class RL108OddImage(Clean):
    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Box(0, 255, (8, 8, 3), np.uint8)

    def observe(self):
        return np.full((8, 8, 3), int(100 + 10 * self.position[0]), np.uint8)


class RL109TupleObservation(CleanDict):
    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Tuple(list(self.observation_space.spaces.values()))

    def observe(self):
        return self.position.copy(), self.steps


class RL109TextObservation(Clean):
    """Of a space that no rule can look into."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Dict({"position": self.observation_space, "say": spaces.Text(5)})

    def observe(self):
        return {"position": self.position.copy(), "say": "abc"}


class _SpaceOfOldGym:
    """What the old gym's Box offers; that package is not installed here, and none of its classes is Gymnasium's."""

    def __init__(self, low, high, shape, dtype):
        self.box = spaces.Box(low, high, shape, dtype)
        self.low, self.high, self.shape, self.dtype = self.box.low, self.box.high, self.box.shape, self.box.dtype

    def sample(self):
        return self.box.sample()

    def contains(self, value):
        return self.box.contains(value)


OldBox = type("Box", (_SpaceOfOldGym,), {"__module__": "gym.spaces.box"})


class RL008SpacesOfGym(Clean):
    """`import gymnasium as gym` and, further down, `from gym import spaces`."""

    def __init__(self):
        super().__init__()
        self.observation_space = OldBox(-self.size, self.size, (2,), np.float32)
        self.action_space = OldBox(-1.0, 1.0, (2,), np.float32)


class RL008ObservationOfGym(Clean):
    def __init__(self):
        super().__init__()
        self.observation_space = OldBox(-self.size, self.size, (2,), np.float32)


class OwnBox(spaces.Box):
    """A box that knows more of its actions, such as their scale."""


class RL106OwnBox(Clean):
    def __init__(self):
        super().__init__()
        self.action_space = OwnBox(-1.0, 3.0, (2,), np.float32)
