"""Attributes of kinds that environments have now and then: the check reads and replaces them, and crashes at none."""

import collections
import dataclasses

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from rlctl.checking.drawn_goals import DrawnPlace
from rlctl.checking.experiment import INSTANCES, PROBE
from rlctl.checking.experiments.attributes import find_declared_numbers
from rlctl.checking.expressions import record_expressions
from rlctl.checking.records import Finished, Skipped
from rlctl.checking.rule import NotJudged, RuleFinding
from rlctl.checking.source_code import SourceCode
from rlctl.checking.values import read_attributes, shape_like
from tests.checking.judging import run_here


class Vector(tuple):
    def __new__(cls, x, y):
        return super().__new__(cls, (x, y))


class Pose(list):
    def __init__(self, x, y):
        super().__init__([x, y])


@dataclasses.dataclass(frozen=True)
class State:
    place: np.ndarray
    goal: np.ndarray


class Robot(gymnasium.Env):
    """Drives to a goal."""

    action_space = spaces.Box(-1.0, 1.0, (2,))
    observation_space = spaces.Box(-20.0, 20.0, (4,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.start()
        return self.observe(), {}

    def start(self):
        self.state = State(*self.np_random.uniform(-1, 1, (2, 2)))

    def read(self):
        return self.state.place, self.state.goal

    def move(self, way):
        self.state = dataclasses.replace(self.state, place=self.state.place + way)

    def observe(self):
        return np.concatenate(self.read())

    def step(self, action):
        self.steps += 1
        self.move(0.05 * np.clip(np.nan_to_num(action), -1, 1))
        place, goal = self.read()
        distance = float(np.linalg.norm(goal - place))
        is_success = distance < 0.05
        return self.observe(), -distance, is_success, self.steps >= 60, {"is_success": is_success}


class Pixels(Robot):
    """Sees only an image."""

    observation_space = spaces.Box(0, 255, (16, 16, 1), np.uint8)

    def observe(self):
        image = np.zeros((16, 16, 1), np.uint8)
        for point, color in zip(self.read(), (100, 200), strict=True):
            row, column = np.clip((point + 1) * 8, 0, 15).astype(int)
            image[row, column] = color
        return image


class Course(Robot):
    """Has two or three waypoints, of which the first is to be reached."""

    def start(self):
        self.place = self.np_random.uniform(-1, 1, 2)
        self.waypoints = self.np_random.uniform(-1, 1, (self.np_random.integers(2, 4), 2))

    def read(self):
        return self.place, self.waypoints[0]

    def move(self, way):
        self.place = self.place + way


class Gusts(Course):
    """Is pushed by one or two hidden gusts."""

    observation_space = spaces.Box(-20.0, 20.0, (2,), np.float64)

    def start(self):
        super().start()
        self.gusts = self.np_random.uniform(-1, 1, self.np_random.integers(1, 3))

    def observe(self):
        return self.place.copy()

    def step(self, action):
        observation, _, _, is_late, info = super().step(action)
        return observation, float(self.gusts.sum() - np.abs(self.place).sum()), False, is_late, info


class Incomplete(Robot):
    """Leaves a key of its observation out in every other step."""

    observation_space = spaces.Dict({name: spaces.Box(-20.0, 20.0, (2,), np.float64) for name in ("place", "goal")})

    def observe(self):
        observation = dict(zip(("place", "goal"), self.read(), strict=True))
        return observation if self.steps % 2 == 0 else {"place": observation["place"]}


class Growing(Robot):
    """Returns more numbers in some steps."""

    def observe(self):
        return np.concatenate([*self.read(), np.zeros(self.steps % 3)])


class Numbers(Robot):
    """Computes with a number that no float has."""

    huge = 10**400

    def move(self, way):
        numbers = [self.huge, 1]
        super().move(way * len(list(numbers)))


class Holder:
    """Holds attributes."""


def test_attributes_are_copied_and_replaced_whatever_their_type_takes():
    env = Holder()
    env.way, env.pose, env.last = Vector(1.0, 2.0), Pose(3.0, 4.0), collections.deque([5.0, 6.0], maxlen=2)
    for name, attribute in read_attributes(env).items():
        attribute.assign(shape_like(attribute.value, attribute.numbers + 1))
        assert np.allclose(read_attributes(env)[name].numbers, attribute.numbers + 1)
    assert [type(one) for one in (env.way, env.pose, env.last)] == [Vector, Pose, collections.deque]
    env.last.append(0.0)
    assert list(env.last) == [7.0, 0.0]


def test_a_frozen_state_is_replaced():
    env = Holder()
    env.state = State(np.zeros(2), np.ones(2))
    read_attributes(env)["self.state.goal"].assign(np.full(2, 3.0))
    assert env.state.goal.tolist() == [3.0, 3.0]


def test_a_goal_that_an_episode_does_not_have_is_not_judged():
    with pytest.raises(NotJudged, match=r"not every episode has the goal self\.goal"):
        DrawnPlace("self.goal", (0, 1)).find(Holder())


def test_whole_numbers_that_no_float_has_are_left_out():
    env = Numbers()
    env.reset(seed=0)
    env.key, env.keys, env.count = env.huge, [env.huge, 1], 3
    assert {"self.key", "self.keys"}.isdisjoint(read_attributes(env))
    declared = find_declared_numbers(env)
    assert declared["self.count"] == 3.0
    assert "huge" not in declared
    with record_expressions(SourceCode(env)) as recorder, recorder.call(1) as noted:
        env.step(np.zeros(2))
    assert noted.events


@pytest.mark.parametrize(
    ("name", "process", "experiments"),
    [
        ("Robot", PROBE, ("goals", "rotated")),
        ("Pixels", PROBE, ("goals", "rotated")),
        ("Course", PROBE, ("goals",)),
        ("Gusts", INSTANCES, ("hidden state",)),
        ("Incomplete", PROBE, ("attributes", "goals", "commands", "sums", "rotated")),
        ("Growing", PROBE, ("sums",)),
    ],
)
def test_experiments_do_not_crash(name, process, experiments):
    messages = list(run_here(process, f"{__file__}:{name}", ["build", *experiments], 60.0))
    assert [message.crash for message in messages if isinstance(message, Finished)] == [""] * (1 + len(experiments))
    rules = {message.rule for message in messages if isinstance(message, RuleFinding)}
    assert rules <= ({"RL114"} if name == "Gusts" else set())
    if name == "Pixels":
        reasons = {message.name: message.reason for message in messages if isinstance(message, Skipped)}
        assert reasons["rotated"] == "nothing that is observed is a real number"
