"""What a snapshot of an environment puts back within an episode."""

import collections

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.instance import Context, Instance
from rlctl.checking.snapshots import Snapshot
from rlctl.environments.spec import EnvSpec


class Wanderer(gym.Env):
    """Holds its state in everything that a step may change in place or replace."""

    def __init__(self):
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.normal(size=2)
        self.seen = collections.deque([self.place.copy()] * 3, maxlen=3)
        self.task = {"visited": [0], "kinds": {1}}
        return self.place.astype(np.float32), {}

    def step(self, action):
        self.place += 0.1 * action + self.np_random.normal(size=2)
        self.seen.append(self.place.copy())
        self.task["visited"].append(len(self.task["visited"]))
        self.task["kinds"].add(len(self.task["visited"]))
        reward = float(self.seen[0].sum() + len(self.task["visited"]) + len(self.task["kinds"]))
        return self.place.astype(np.float32), reward, False, False, {}


class Forgetful(Wanderer):
    """Counts its steps where no snapshot looks."""

    def reset(self, **keywords):
        self.numbers = iter(range(1000))
        return super().reset(**keywords)

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, float(next(self.numbers)), *rest


def begin(env):
    instance = Instance(gym.wrappers.TimeLimit(env, 50), Context(EnvSpec("none")))
    instance.context.budget.deadline = instance.context.budget.last = float("inf")
    player = EpisodePlayer(instance, 3, "repeated")
    player.reset()
    player.step()
    return instance, player


def test_steps_repeat_after_it_is_restored():
    instance, player = begin(Wanderer())
    snapshot = Snapshot(instance)
    first = [player.step().reward for _ in range(4)]
    snapshot.restore()
    player.resume(1)
    assert [player.step().reward for _ in range(4)] == first
    assert player.steps == 5


def test_it_is_valid_until_the_next_reset():
    instance, player = begin(Wanderer())
    snapshot = Snapshot(instance)
    assert snapshot.is_valid
    player.reset()
    assert not snapshot.is_valid


@pytest.mark.parametrize(("kind", "is_faithful"), [(Wanderer, True), (Forgetful, False)])
def test_it_knows_whether_it_has_everything(kind, is_faithful):
    instance, player = begin(kind())
    assert Snapshot(instance).is_faithful(player) == is_faithful
