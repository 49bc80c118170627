"""RL644: constraints that a step makes, where what empties the world stands in a file of another folder."""

import pytest

from tests.checking.judging import found_in_source

pytestmark = [pytest.mark.pybullet, pytest.mark.slow]

EMPTY = """
def empty(p, client):
    p.resetSimulation(physicsClientId=client)
"""
FORGET = """
def empty(p, client):
    pass
"""
WELDER = """
import gymnasium
import numpy as np
import pybullet as p
from {folder}.emptying import empty


class Welder(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self):
        self.client = p.connect(p.DIRECT)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        empty(p, self.client)
        if p.getNumBodies(physicsClientId=self.client) == 0:
            self.box = p.createMultiBody(1.0, physicsClientId=self.client)
        place = [*self.np_random.uniform(-1, 1, 2), 0.0]
        p.resetBasePositionAndOrientation(self.box, place, [0, 0, 0, 1], physicsClientId=self.client)
        return self.observe(), {{}}

    def step(self, action):
        if action[0] > 0.9:
            none = [0, 0, 0]
            p.createConstraint(
                self.box, -1, -1, -1, p.JOINT_FIXED, none, none, none, physicsClientId=self.client
            )
        p.stepSimulation(physicsClientId=self.client)
        return self.observe(), 0.0, False, False, {{}}

    def observe(self):
        return np.array(p.getBasePositionAndOrientation(self.box, physicsClientId=self.client)[0])

    def close(self):
        p.disconnect(self.client)
"""


@pytest.mark.parametrize(("emptying", "rules"), [(EMPTY, set()), (FORGET, {"RL644"})], ids=["emptied", "kept"])
def test_a_constraint_is_left_over_where_no_reset_empties_the_world(emptying, rules, tmp_path, monkeypatch):
    folder = f"worlds_that_are_{'kept' if rules else 'emptied'}"  # a module is imported once
    (tmp_path / folder).mkdir()
    (tmp_path / folder / "emptying.py").write_text(emptying)
    (tmp_path / "envs").mkdir()
    (tmp_path / "envs" / "welder.py").write_text(WELDER.format(folder=folder))
    monkeypatch.syspath_prepend(tmp_path)
    assert {*found_in_source(f"{tmp_path}/envs/welder.py:Welder")} & {"RL644"} == rules
