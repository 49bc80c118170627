"""What is refused, or said, before training: spaces that SB3 cannot use, steps that are rounded up."""

import numpy as np
import pytest
from gymnasium import spaces

from rlctl.errors import RecipeError
from rlctl.recipe.recipe import Recipe
from rlctl.recipe.sources import describe_rounding, fill_defaults
from rlctl.training.algorithms import check_spaces
from rlctl.training.start import preserve_process_state

BOX = spaces.Box(-1, 1, (2,))


@pytest.mark.parametrize(
    ("algo", "observation", "action", "message"),
    [
        (
            "dqn",
            BOX,
            BOX,
            "dqn cannot be used here: it needs Discrete actions, these are Box(-1.0, 1.0, (2,), float32)",
        ),
        (
            "sac",
            BOX,
            spaces.Discrete(3),
            "sac cannot be used here: it needs Box actions, these are Discrete(3); try ppo",
        ),
        (
            "ppo",
            spaces.Dict({"gripper": spaces.Discrete(4, start=2), "arm": BOX}),
            BOX,
            "observation 'gripper' is Discrete(4, start=2), and Stable-Baselines3 counts categories from 0: "
            "leave start out of the space, and observe values less start",
        ),
        (
            "ppo",
            spaces.MultiDiscrete([4, 4], start=[0, 1]),
            BOX,
            "the observation is MultiDiscrete([4 4], start=[0 1])",
        ),
        (
            "sac",
            spaces.Dict({"x": spaces.Box(0, 1, ())}),
            BOX,
            "observation 'x' is Box(0.0, 1.0, (), float32), a single ",
        ),
        ("ppo", BOX, spaces.Box(-1, 1, (0,)), "the action is Box([], [], (0,), float32), which has no element"),
        (
            "ppo",
            BOX,
            spaces.Discrete(3, start=-1),
            "the action is Discrete(3, start=-1), and Stable-Baselines3 counts categories from 0: "
            "leave start out of the space, and add start in step",
        ),
    ],
)
def test_spaces_that_are_refused(algo, observation, action, message):
    with pytest.raises(RecipeError) as caught:
        check_spaces(algo, observation, action)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("algo", ["dqn", "sac"])
def test_only_what_takes_the_actions_is_advised(algo):
    with pytest.raises(RecipeError, match=r"these are MultiDiscrete\(\[3 2\]\); try ppo$"):
        check_spaces(algo, BOX, spaces.MultiDiscrete([3, 2]))


def test_spaces_that_are_not():
    for algo in ("ppo", "a2c"):
        check_spaces(algo, spaces.Dict({"gripper": spaces.Discrete(4), "arm": BOX}), spaces.Discrete(3))
    check_spaces("dqn", BOX, spaces.Discrete(3))
    check_spaces("td3", BOX, BOX)


def test_whole_rollouts_are_said_where_they_are_many_more_steps():
    # 8 environments, 4096 / 8 = 512 steps each.
    assert describe_rounding(fill_defaults(Recipe(total_timesteps=10))) == (
        "training takes 4,096 steps, not 10: ppo needs whole rollouts of 4,096 steps (n_steps x n_envs)"
    )
    assert describe_rounding(fill_defaults(Recipe(total_timesteps=300_000))) is None
    assert describe_rounding(fill_defaults(Recipe(algo="sac", total_timesteps=10))) is None


def test_a_module_that_changes_defaults_changes_no_training():
    import torch

    with preserve_process_state():
        torch.set_default_dtype(torch.float64)
        torch.set_default_device("meta")
        torch.set_grad_enabled(False)
        np.seterr(all="raise")
    assert (torch.zeros(1).dtype, torch.zeros(1).device.type) == (torch.float32, "cpu")
    assert torch.is_grad_enabled()
    assert np.float32(1e38) * np.float32(1e38) == np.inf
