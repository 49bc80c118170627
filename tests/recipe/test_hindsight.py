"""Hindsight is suggested for environments with goals and a sparse reward, with options that exist."""

import numpy as np
import pytest
from gymnasium import spaces

from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.recipe.hindsight import find_problem, has_sparse_reward, suggest_hindsight
from rlctl.recipe.recipe import validate

PLACE = spaces.Box(-1.0, 1.0, (2,), np.float32)
KEYS = ("observation", "achieved_goal", "desired_goal")


def describe(*keys, action=PLACE, has_compute_reward=True):
    return EnvInfo(
        observation_space=space_to_json(spaces.Dict(dict.fromkeys(keys, PLACE))),
        action_space=space_to_json(action),
        has_compute_reward=has_compute_reward,
    )


@pytest.mark.parametrize(
    ("algo", "action", "options"),
    [
        ("sac", PLACE, "--algo sac --set her={}"),
        ("tqc", PLACE, "--algo tqc --set her={}"),
        ("ppo", PLACE, "--algo sac --set her={}"),
        ("dqn", spaces.Discrete(4), "--algo dqn --set her={}"),
        ("ppo", spaces.Discrete(4), "--algo dqn --set her={}"),
    ],
)
def test_options_turn_hindsight_on(algo, action, options):
    assert suggest_hindsight(validate({"algo": algo}, "test"), describe(*KEYS, action=action)) == options
    changed = validate({"algo": options.split()[1], "her": {}}, "test")
    assert find_problem(changed, describe(*KEYS, action=action)) is None
    assert suggest_hindsight(changed, describe(*KEYS, action=action)) is None


@pytest.mark.parametrize(
    ("recipe", "env"),
    [
        ({}, describe("observation", "achieved_goal")),
        ({}, describe(*KEYS, has_compute_reward=False)),
        ({"reward_weights": {"reach": 2.0}}, describe(*KEYS)),
        ({"stages": [{"reward_weights": {"reach": 2.0}, "promote": {"success": 0.5}}, {}]}, describe(*KEYS)),
        ({"algo": "sac", "algo_kwargs": {"n_steps": 3}}, describe(*KEYS)),
    ],
)
def test_what_excludes_hindsight_gets_no_suggestion(recipe, env):
    assert suggest_hindsight(validate(recipe, "test"), env) is None


def test_sparse_rewards():
    assert has_sparse_reward([np.full(50, -1.0)]) is True
    assert has_sparse_reward([np.full(30, -1.0), np.array([-1.0, 0.0])]) is True
    assert has_sparse_reward([np.linspace(-1, 0, 50)]) is False
    assert has_sparse_reward([np.full(5, -1.0)]) is None
    assert has_sparse_reward([]) is None
