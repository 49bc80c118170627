"""The time limit of a plain environment: registered, or by a wrapper that its own factory puts around it."""

import gymnasium
import pytest
from gymnasium.wrappers import TimeLimit

from rlctl.environments.spec import EnvSpec
from rlctl.environments.wrappers import find_time_limit


class Endless(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    action_space = gymnasium.spaces.Discrete(2)


def make_limited():
    return gymnasium.Wrapper(TimeLimit(Endless(), 50))


@pytest.mark.parametrize(
    ("env", "limit"),
    [
        (Endless(), None),
        (make_limited(), 50),
        (TimeLimit(make_limited(), 70), 50),
        (gymnasium.make("Pendulum-v1"), 200),
        (gymnasium.make("Pendulum-v1", max_episode_steps=30), 30),
    ],
)
def test_the_shortest_limit_counts(env, limit):
    assert find_time_limit(env) == limit


def test_a_limit_of_the_factory_is_enough_for_the_time_feature():
    env = EnvSpec(f"{__file__}:make_limited", time_feature=True).make()
    assert env.observation_space.shape == (3,)
