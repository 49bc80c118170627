"""The critics of XQC: distributions of the return on fixed atoms, and weights of unit norm."""

import numpy as np
import pytest
import torch
from gymnasium import spaces

from rlctl.policy.xqc import XqcPolicy
from rlctl.recipe import sources
from rlctl.training.updates.xqc import project

OBSERVATIONS, ACTIONS = (spaces.Box(-1, 1, (size,), np.float32) for size in (4, 2))


def make_policy(**arguments):
    return XqcPolicy(OBSERVATIONS, ACTIONS, lambda _: 1e-3, net_arch=[8, 8], **arguments)


ATOMS = np.array([-1, 0, 1], np.float32)
PROBABILITIES = np.array([[0.5, 0.0, 0.5], [0.0, 1.0, 0.0], [0.25, 0.5, 0.25]], np.float32)
# Row 0: returns between atoms. 0.5 at -0.75 gives 0.375 to -1 and 0.125 to 0; 0.5 at 0.5 gives 0.25 to 0 and to 1.
# Row 1: an atom itself, after the end of an episode. Row 2: returns outside of the atoms, which go to the ends.
RETURNS = np.array([[-0.75, 0.0, 0.5], [1.0, 1.0, 1.0], [-9.0, 0.0, 9.0]], np.float32)
PROJECTED = np.array([[0.375, 0.375, 0.25], [0.0, 0.0, 1.0], [0.25, 0.5, 0.25]], np.float32)


def test_a_distribution_is_projected_to_the_atoms():
    critic = make_policy(n_atoms=3, v_min=-1.0, v_max=1.0).critic
    of_torch = critic.project(torch.from_numpy(PROBABILITIES), torch.from_numpy(RETURNS))
    np.testing.assert_allclose(of_torch, PROJECTED, atol=1e-7)
    np.testing.assert_allclose(project(PROBABILITIES, RETURNS, ATOMS), PROJECTED, atol=1e-7)


def test_a_value_is_the_expected_return():
    critic = make_policy(n_atoms=3, v_min=-2.0, v_max=4.0).critic
    logits = torch.tensor([[[0.2, 0.3, 0.5]]]).log()
    # 0.2 * -2 + 0.3 * 1 + 0.5 * 4 = 1.9
    assert critic.compute_values(logits).item() == pytest.approx(1.9)
    values = critic(torch.zeros(5, 4), torch.zeros(5, 2))
    assert [value.shape for value in values] == [(5, 1), (5, 1)]


def test_the_weights_into_each_unit_of_a_critic_have_unit_norm():
    critic = make_policy().critic
    linear = {name: module for name, module in critic.named_modules() if isinstance(module, torch.nn.Linear)}
    assert list(linear) == [f"qf{network}.{index}" for network in (0, 1) for index in (1, 4, 7)]
    for name, layer in linear.items():
        square = layer.weight.square().sum(1)
        if not name.endswith("7"):  # a hidden layer
            square += layer.bias.square()
        torch.testing.assert_close(square, torch.ones_like(square), msg=name)


def test_rewards_are_normalised_unless_the_recipe_says_otherwise():
    own = {"observation": True, "reward": False}
    for given, expected in ((None, (False, True)), (own, (True, False))):
        recipe = sources.resolve("Pendulum-v1", None, {"algo": "xqc", "normalize": given})
        assert (recipe.normalize.observation, recipe.normalize.reward) == expected
