"""Every network that can be trained acts in numpy as it does in torch."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError
from rlctl.policy.actor import Exploration, Rows, as_rows
from rlctl.policy.file import ACTOR_CRITIC, PolicyFile, PolicyInfo
from rlctl.policy.load import check_playable
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.policy.torch_policy import ALGORITHMS, TorchActor, describe_network, policy_name

FLAT, BOX = spaces.Box(-np.inf, np.inf, (6,)), spaces.Box(-2, 3, (2,))
IMAGE = spaces.Box(0, 255, (36, 40, 3), np.uint8)
DICT = spaces.Dict({"z": spaces.Box(-1, 1, (3,)), "image": IMAGE, "a": spaces.Discrete(4)})
CASES = {
    "ppo": ("ppo", FLAT, BOX, {}),
    "ppo, gSDE": ("ppo", FLAT, BOX, {"use_sde": True}),
    "ppo, gSDE, squashed": (
        "ppo",
        FLAT,
        BOX,
        {"use_sde": True, "policy_kwargs": {"squash_output": True, "full_std": False, "use_expln": True}},
    ),
    "ppo, elu": ("ppo", FLAT, BOX, {"policy_kwargs": {"activation_fn": torch.nn.ELU}}),
    "ppo, silu": ("ppo", FLAT, BOX, {"policy_kwargs": {"activation_fn": torch.nn.SiLU}}),
    "ppo, no layers": ("ppo", FLAT, BOX, {"policy_kwargs": {"net_arch": []}}),
    "ppo, dict": ("ppo", DICT, BOX, {}),
    "ppo, image, channels first": ("ppo", spaces.Box(0, 255, (3, 40, 36), np.uint8), BOX, {}),
    "ppo, categories": ("ppo", spaces.MultiDiscrete([3, 2]), spaces.MultiDiscrete([3, 4]), {}),
    "ppo, binary": ("ppo", spaces.MultiBinary(3), spaces.MultiBinary(4), {}),
    "a2c, discrete": ("a2c", FLAT, spaces.Discrete(5), {}),
    "recurrent_ppo": ("recurrent_ppo", FLAT, BOX, {"policy_kwargs": {"lstm_hidden_size": 8, "n_lstm_layers": 2}}),
    "sac": ("sac", FLAT, BOX, {}),
    "sac, gSDE": ("sac", FLAT, BOX, {"use_sde": True}),
    "sac, image": ("sac", IMAGE, BOX, {}),
    "tqc": ("tqc", FLAT, BOX, {}),
    "crossq": ("crossq", FLAT, BOX, {"policy_kwargs": {"net_arch": [16, 16]}}),
    "xqc": ("xqc", FLAT, BOX, {"policy_kwargs": {"net_arch": [16, 16]}}),
    "td3": ("td3", FLAT, BOX, {}),
    "ddpg": ("ddpg", FLAT, BOX, {}),
    "dqn": ("dqn", FLAT, spaces.Discrete(5), {}),
}


class Unused(gym.Env):
    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space


@pytest.fixture
def policy():
    """Return description, tensors and the torch actor of an untrained model."""

    def make(case):
        algo, observation, action, kwargs = CASES[case]
        torch.manual_seed(1)
        buffer = {"buffer_size": 10} if algo in (*ACTOR_CRITIC, "dqn") else {}
        env = DummyVecEnv([lambda: Unused(observation, action)])
        network = ALGORITHMS[algo](policy_name(algo, observation), env, device="cpu", **buffer, **kwargs).policy
        for name, values in network.named_buffers():
            if ".ra_" in name:  # else batch renorm would have nothing to do
                values.copy_(torch.rand_like(values) + 0.1)
        tensors = {f"policy/{name}": value.numpy().copy() for name, value in network.state_dict().items()}
        keys = [key for key, space in ({"": observation} if observation is FLAT else {}).items() if space is FLAT]
        for key in keys:
            tensors |= {f"normalize/{key}/mean": np.full(6, 0.3), f"normalize/{key}/var": np.linspace(0.001, 4, 6)}
        info = PolicyInfo(
            algo=algo,
            policy=policy_name(algo, observation),
            policy_kwargs=describe_network(network),
            clip_observation=2.0 if keys else None,
            normalized_keys=keys,
            env=EnvInfo(observation_space=space_to_json(observation), action_space=space_to_json(action)),
            spec=EnvSpec("test"),
        )
        policy = PolicyFile(info, tensors)
        return policy, TorchActor(policy, network)

    return make


def act(actor, observation, seed, step):
    """Return the stored action and the environment's for one observation."""
    stored, action = actor.act(as_rows(observation), Rows.one(seed, step))
    return stored[0], action[0]


@pytest.mark.slow_except(first=8)
@pytest.mark.parametrize("case", CASES)
def test_it_acts_as_torch_does(policy, case):
    file, torch_actor = policy(case)
    actor = NumpyActor(file.actor_only())
    space = file.info.env.spaces()[0]
    space.seed(0)
    for step in range(8):
        observation = space.sample()
        expected = act(torch_actor, observation, 0, step)[1]
        np.testing.assert_allclose(act(actor, observation, 0, step)[1], expected, atol=2e-6)


@pytest.mark.slow_except(first=8)
@pytest.mark.parametrize("case", [case for case in CASES if "dict" not in case and "image" not in case])
def test_samples_stay_in_the_space(policy, case):
    file, _ = policy(case)
    actor = NumpyActor(file)
    observed, space = file.info.env.spaces()
    observation = observed.sample()
    for exploration in (
        Exploration(stochastic=True, sde_every=2),
        Exploration(stochastic=True, action_noise=0.5, epsilon=0.5),
        Exploration(warmup=True),
    ):
        actor.explore(exploration)
        actor.prepare()
        actions = [act(actor, observation, 5, step)[1] for step in range(50)]
        assert all(space.contains(np.asarray(action).astype(space.dtype)) for action in actions)
        again = act(actor, observation, 5, 7)[1]
        if "recurrent" not in case and not (exploration.sde_every and "gSDE" in case):
            np.testing.assert_array_equal(again, actions[7])


def test_a_gaussian_has_the_mean_and_deviation_of_its_numbers(policy):
    file, _ = policy("ppo")
    file.tensors["policy/log_std"][:] = np.log(0.25)
    actor = NumpyActor(file)
    observation = np.zeros(6, np.float32)
    mean, _ = act(actor, observation, 0, 0)
    actor.explore(Exploration(stochastic=True))
    actor.prepare()
    stored = np.array([act(actor, observation, 9, step)[0] for step in range(4000)])
    # The error of a mean of 4000 is 0.25 / 63 = 0.004, that of the deviation 0.0028.
    np.testing.assert_allclose(stored.mean(axis=0), mean, atol=0.02)
    np.testing.assert_allclose(stored.std(axis=0), 0.25, atol=0.015)


def test_choices_are_sampled_with_their_probabilities(policy):
    file, _ = policy("a2c, discrete")
    logits = np.log([0.1, 0.2, 0.4, 0.25, 0.05])
    file.tensors["policy/action_net.weight"][:] = 0.0
    file.tensors["policy/action_net.bias"][:] = logits
    actor = NumpyActor(file, 4000)
    assert actor.act(np.zeros((1, 6), np.float32), Rows.one())[1] == 2
    actor.explore(Exploration(stochastic=True))
    rows = Rows.first(4000)
    rows.seed[:] = np.arange(4000)
    _, actions = actor.act(np.zeros((4000, 6), np.float32), rows)
    # The error of a fraction of 4000 is at most 0.008.
    np.testing.assert_allclose(np.bincount(actions, minlength=5) / 4000, np.exp(logits), atol=0.03)


def test_tensors_that_do_not_fit(policy):
    file, _ = policy("ppo")
    tensors = {**file.tensors, "policy/action_net.weight": np.zeros((2, 3), np.float32)}
    with pytest.raises(ArtifactError, match=r"x.safetensors: its tensors do not fit its description: "):
        check_playable(PolicyFile(file.info, tensors, Path("x.safetensors")))


@pytest.mark.parametrize("case", ["ppo", "ppo, gSDE"])
def test_a_gaussian_policy_without_log_std(policy, case):
    file, _ = policy(case)
    tensors = {name: values for name, values in file.tensors.items() if name != "policy/log_std"}
    with pytest.raises(
        ArtifactError, match=r"x.safetensors: its tensors do not fit its description: log_std is missing"
    ):
        check_playable(PolicyFile(file.info, tensors, Path("x.safetensors")))
