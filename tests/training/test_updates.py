"""Updates whose gradients are computed without autograd: Stable-Baselines3's own, but for rounding."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from rlctl.environments.dict_spaces import map_parts, split
from rlctl.errors import RecipeError
from rlctl.policy.xqc import XQC
from rlctl.task.mirror import Mirror
from rlctl.training.privileged import POLICIES
from rlctl.training.updates.choice import choose_update
from rlctl.training.updates.crossq import CrossQUpdate
from rlctl.training.updates.ppo import PpoUpdate
from rlctl.training.updates.q_learning import DqnUpdate, Td3Update
from rlctl.training.updates.sac import SacUpdate, TqcUpdate
from rlctl.training.updates.xqc import XqcUpdate

pytestmark = pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")

VECTOR = spaces.Box(-np.inf, np.inf, (5,), np.float32)
ACTIONS = spaces.Box(-1, 1, (3,), np.float32)


class Still(gym.Env):
    """Spaces; it is never stepped."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}


def make_ppo(observations=VECTOR, actions=ACTIONS, policy="MlpPolicy", network=None, **settings):
    """A model with a rollout of made-up numbers that is no multiple of the minibatches."""
    network = {"net_arch": [16, 16], **(network or {})}
    settings = {"n_steps": 25, "batch_size": 16, "n_epochs": 3, "learning_rate": 1e-2, "seed": 0, **settings}
    model = PPO(
        policy, DummyVecEnv([lambda: Still(observations, actions)] * 2), policy_kwargs=network, device="cpu", **settings
    )
    model.set_logger(Logger(None, []))
    rng, buffer = np.random.default_rng(0), model.rollout_buffer
    for rows in (
        *split(buffer.observations).values(),
        buffer.actions,
        buffer.advantages,
        buffer.returns,
        buffer.values,
    ):
        rows[...] = rng.standard_normal(rows.shape)
    buffer.log_probs[...] = rng.normal(-4, 1, buffer.log_probs.shape)
    buffer.full = True
    return model


def weights(model):
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def assert_same_weights(one, other, before):
    assert any((one[name] - before[name]).abs().max() > 1e-3 for name in before)
    for name in one:
        torch.testing.assert_close(one[name], other[name], rtol=1e-4, atol=1e-5, msg=name)


PRIVILEGED = {"privileged": {"velocity": 2}}  # of VECTOR the actor sees the first three elements
PPO_CASES = {
    "privileged": {"policy": POLICIES["ppo"], "network": PRIVILEGED},
    "tanh": {},
    "relu": {"network": {"activation_fn": torch.nn.ReLU}},
    "gSDE": {"use_sde": True},
    "gSDE, relu, no hidden layer of the critic": {
        "use_sde": True,
        "network": {"activation_fn": torch.nn.ReLU, "net_arch": {"pi": [8], "vf": []}},
    },
    "clipped values and gradients, entropy": {"clip_range_vf": 0.2, "ent_coef": 0.1, "max_grad_norm": 0.1},
    "advantages as they are": {"normalize_advantage": False},
    "stopped by target_kl": {"target_kl": 8.0},
    "actions in float64": {"actions": spaces.Box(-1, 1, (3,), np.float64)},
    "dict": {"observations": spaces.Dict({"a": VECTOR, "b": VECTOR}), "policy": "MultiInputPolicy"},
}


@pytest.mark.slow_except("tanh", "gSDE", "advantages as they are")
@pytest.mark.parametrize("name", PPO_CASES)
def test_ppo_updates_as_sb3(name):
    one, other = make_ppo(**PPO_CASES[name]), make_ppo(**PPO_CASES[name])
    before = weights(one)
    assert PpoUpdate.supports(other)
    set_random_seed(1)
    one.train()
    set_random_seed(1)
    PpoUpdate(other).train()
    assert_same_weights(weights(one), weights(other), before)
    expected, logged = one.logger.name_to_value, other.logger.name_to_value
    assert dict(logged) == pytest.approx(dict(expected), rel=1e-3, abs=1e-4)


def test_mirror_images_are_learned_from_as_if_they_had_been_played():
    places = (-2, -1, 3, 5, 4), (1, -3, -2)
    one, other = (make_ppo(batch_size=100, n_epochs=1, normalize_advantage=False) for _ in range(2))
    other.mirror = places
    buffer = one.rollout_buffer
    one.batch_size = 200
    for name, mirror in (("observations", Mirror(places[0])), ("actions", Mirror(places[1]))):
        values = getattr(buffer, name)
        setattr(buffer, name, np.concatenate([values, mirror(values)]))
    for name in ("advantages", "returns", "values", "log_probs"):
        setattr(buffer, name, np.concatenate([getattr(buffer, name)] * 2))
    buffer.buffer_size *= 2
    before = weights(one)
    one.train()
    PpoUpdate(other).train()
    assert_same_weights(weights(one), weights(other), before)
    expected, logged = one.logger.name_to_value, other.logger.name_to_value
    assert dict(logged) == pytest.approx(dict(expected), rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("images", [True, False])
def test_the_mirror_loss_has_the_gradient_of_autograd(images):
    places, weight = ((-2, -1, 3, 5, 4), (1, -3, -2)), 0.5
    without, with_loss, model = (
        make_ppo(batch_size=100, n_epochs=1, normalize_advantage=False, max_grad_norm=1e9) for _ in range(3)
    )
    if images:
        without.mirror = places
    with_loss.mirror, with_loss.mirror_images, with_loss.mirror_loss = places, images, weight
    gradients = []
    for each in (without, with_loss):
        update = PpoUpdate(each)
        update.train()
        gradients.append(update._arrays["gradient"].copy())

    def compute_means(rows):
        return model.policy.get_distribution(torch.from_numpy(rows)).distribution.mean

    rows = split_rows(model.rollout_buffer.observations)
    mirror_action = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, -1, 0]])
    differences = compute_means(rows) - compute_means(Mirror(places[0])(rows)) @ mirror_action
    loss = differences.square().sum(1).mean()
    actor = [*model.policy.mlp_extractor.policy_net.parameters(), *model.policy.action_net.parameters()]
    expected = torch.cat([part.ravel() for part in torch.autograd.grad(weight * loss, actor)]).numpy()
    difference = gradients[1] - gradients[0]
    np.testing.assert_allclose(difference[: len(expected)], expected, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(difference[len(expected) :], 0.0, atol=1e-6)
    assert with_loss.logger.name_to_value["train/mirror_loss"] == pytest.approx(loss.item(), rel=1e-4)
    assert "train/mirror_loss" not in without.logger.name_to_value


@pytest.mark.parametrize("name", ["tanh", "gSDE, relu, no hidden layer of the critic", "dict"])
def test_ppo_evaluates_as_sb3(name):
    model = make_ppo(**PPO_CASES[name])
    observations, _ = model.policy.obs_to_tensor(split_rows(model.rollout_buffer.observations))
    actions = model.rollout_buffer.swap_and_flatten(model.rollout_buffer.actions)
    with torch.no_grad():
        expected, expected_log_probs, _ = model.policy.evaluate_actions(observations, torch.from_numpy(actions))
    values, log_probs = PpoUpdate(model).evaluate(observations, actions)
    np.testing.assert_allclose(values, expected.flatten(), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(log_probs, expected_log_probs, rtol=1e-4, atol=1e-4)


def split_rows(observations):
    return map_parts(lambda rows: rows.swapaxes(0, 1).reshape(-1, *rows.shape[2:]), observations)


def make_off_policy(
    algorithm=SAC, observations=VECTOR, policy="MlpPolicy", network=None, actions=ACTIONS, normalize=False, **settings
):
    """A model with a replay buffer of made-up numbers; with `normalize` of two environments whose scales differ."""
    settings = {"batch_size": 16, "learning_rate": 1e-2, "buffer_size": 200, "seed": 0, **settings}
    network = {"net_arch": [16, 16], **(network or {})}
    envs = DummyVecEnv([lambda: Still(observations, actions)] * (2 if normalize else 1))
    if normalize:
        envs = VecNormalize(envs, clip_obs=1.5)
        for rms in split(envs.obs_rms).values():
            rms.mean[:], rms.var[:] = 0.3, 0.25
        envs.ret_rms.var = 4.0
    model = algorithm(policy, envs, policy_kwargs=network, device="cpu", **settings)
    model.set_logger(Logger(None, []))
    rng, buffer = np.random.default_rng(0), model.replay_buffer
    both = (buffer.observations, buffer.next_observations)
    for rows in (*(part for each in both for part in split(each).values()), buffer.actions, buffer.rewards):
        rows[...] = rng.uniform(-1, 1, rows.shape)
    if isinstance(actions, spaces.Discrete):
        buffer.actions[...] = rng.integers(0, actions.n, buffer.actions.shape)
    buffer.dones[...] = rng.random(buffer.dones.shape) < 0.1
    buffer.timeouts[...] = buffer.dones * (rng.random(buffer.dones.shape) < 0.5)
    buffer.pos, buffer.full = 50, True
    return model


SAC_CASES = {
    "relu": {},
    "tanh, another entropy, seldom followed": {
        "network": {"activation_fn": torch.nn.Tanh},
        "target_entropy": -1.0,
        "target_update_interval": 3,
    },
    "gSDE": {"use_sde": True},
    "gSDE, clipped mean": {"use_sde": True, "network": {"clip_mean": 0.02}},
    "fixed entropy coefficient, three critics": {"ent_coef": 0.2, "network": {"n_critics": 3}},
    "several steps": {"n_steps": 3},
    "several steps, normalized": {"n_steps": 4, "normalize": True, "batch_size": 100},
    "normalized": {"normalize": True},
    "dict": {"observations": spaces.Dict({"a": VECTOR, "b": VECTOR}), "policy": "MultiInputPolicy"},
    "dict, normalized": {
        "observations": spaces.Dict({"a": VECTOR, "b": VECTOR}),
        "policy": "MultiInputPolicy",
        "normalize": True,
        "seed": 2,
    },
}


SAC_CASES["privileged"] = {"policy": POLICIES["sac"], "network": PRIVILEGED, "normalize": True}
TQC_CASES = {
    "tqc, privileged": {"policy": POLICIES["tqc"], "network": PRIVILEGED},
    "tqc": {"network": {"n_quantiles": 7, "n_critics": 3}},
    "tqc, gSDE, nothing dropped": {"use_sde": True, "top_quantiles_to_drop_per_net": 0},
}
OFF_POLICY_CASES = {name: (SacUpdate, SAC, case) for name, case in SAC_CASES.items()}
OFF_POLICY_CASES |= {name: (TqcUpdate, TQC, case) for name, case in TQC_CASES.items()}
CROSSQ_CASES = {
    "crossq": {},
    "crossq, renormalized from the third update": {"network": {"renorm_warmup_steps": 1, "batch_norm_momentum": 0.3}},
    "crossq, gSDE, tanh, three critics": {
        "use_sde": True,
        "network": {"activation_fn": torch.nn.Tanh, "n_critics": 3, "renorm_warmup_steps": 0},
    },
    "crossq, actor in every update": {"policy_delay": 1, "ent_coef": 0.2},
    "crossq, no batch normalization": {"network": {"batch_norm": False}},
}
OFF_POLICY_CASES |= {name: (CrossQUpdate, CrossQ, case) for name, case in CROSSQ_CASES.items()}
XQC_CASES = {
    "xqc": {},
    "xqc, gSDE, tanh, three critics": {"use_sde": True, "network": {"activation_fn": torch.nn.Tanh, "n_critics": 3}},
    "xqc, returns outside of the atoms": {"network": {"n_atoms": 11, "v_min": -0.5, "v_max": 0.25}, "ent_coef": 0.2},
    "xqc, several steps, normalized": {"n_steps": 3, "normalize": True, "policy_delay": 1, "seed": 1},
    "xqc, dict": {"observations": spaces.Dict({"a": VECTOR, "b": VECTOR}), "policy": "MultiInputPolicy"},
    "xqc, privileged": {"policy": POLICIES["xqc"], "network": PRIVILEGED, "seed": 2},
    "xqc, no batch normalization": {"network": {"batch_norm": False}},
}
OFF_POLICY_CASES |= {name: (XqcUpdate, XQC, case) for name, case in XQC_CASES.items()}
OFF_POLICY_CASES |= {
    "td3": (Td3Update, TD3, {"policy_delay": 2}),
    "td3, tanh, three critics": (Td3Update, TD3, {"network": {"activation_fn": torch.nn.Tanh, "n_critics": 3}}),
    "ddpg": (Td3Update, DDPG, {"seed": 1}),
    "dqn": (DqnUpdate, DQN, {"actions": spaces.Discrete(3), "max_grad_norm": 0.1}),
}


@pytest.mark.slow_except("dict, normalized", "gSDE", "tqc", "dqn")
@pytest.mark.parametrize("name", OFF_POLICY_CASES)
def test_off_policy_updates_as_sb3(name):
    update, algorithm, case = OFF_POLICY_CASES[name]
    one, other, first = (make_off_policy(algorithm, **case) for _ in range(3))
    before = weights(one)
    assert update.supports(other)
    learner = update(other)
    for steps in (1, 7):
        set_random_seed(steps)
        one.train(gradient_steps=steps, batch_size=one.batch_size)
        set_random_seed(steps)
        learner.train(gradient_steps=steps, batch_size=one.batch_size)
        set_random_seed(steps)
        first.train(gradient_steps=1, batch_size=one.batch_size)
        # The critics' loss is that of the first update, which stands for 32.
        expected = dict(one.logger.name_to_value)
        if issubclass(update, SacUpdate):
            expected["train/critic_loss"] = first.logger.name_to_value["train/critic_loss"]
        assert dict(other.logger.name_to_value) == pytest.approx(expected, rel=1e-3, abs=1e-4)
    assert_same_weights(weights(one), weights(other), before)


WIDE = {"network": {"net_arch": [300, 300]}, "batch_size": 128}


@pytest.mark.slow_except("PPO", "TD3")
@pytest.mark.parametrize("algorithm", [PPO, SAC, TQC, TD3, CrossQ, XQC])
def test_wide_networks_are_updated_on_all_cores_to_the_same_bit(algorithm, use_cores):
    def train():
        set_random_seed(1)
        settings = {**WIDE, **({"n_steps": 100} if algorithm is PPO else {})}
        model = make_ppo(**settings) if algorithm is PPO else make_off_policy(algorithm, **settings)
        learner, arguments = choose_update(model), {} if algorithm is PPO else {"gradient_steps": 3, "batch_size": 128}
        learner.train(**arguments)
        learner.close()
        return weights(model)

    with use_cores(1):
        on_one = train()
    on_all = train()
    assert all(torch.equal(on_one[name], on_all[name]) for name in on_one)


def test_what_sb3_updates_itself():
    image = spaces.Box(0, 255, (3, 36, 36), np.uint8)
    elu = {"activation_fn": torch.nn.ELU}
    ppo = [make_ppo(actions=spaces.Discrete(3)), make_ppo(image, policy="CnnPolicy"), make_ppo(network=elu)]
    sac = [make_off_policy(network=elu), make_off_policy(network={"net_arch": []}), make_off_policy(TQC)]
    sac += [make_off_policy(observations=image, policy="CnnPolicy")]
    sac += [make_off_policy(use_sde=True, network={"use_expln": True})]
    sac += [make_off_policy(XQC, network=elu)]
    assert [choose_update(model) for model in ppo] == ppo
    assert not SacUpdate.supports(sac.pop(2))
    assert [choose_update(model) for model in sac] == sac


def test_a_delayed_actor_learns_at_every_other_update():
    model = make_off_policy()
    model.policy_delay = 2
    learner = choose_update(model)
    actors = []
    for _ in range(4):
        before = weights(model)
        learner.train(gradient_steps=1, batch_size=16)
        after = weights(model)
        assert not torch.equal(before["critic.qf0.0.weight"], after["critic.qf0.0.weight"])
        actors.append(not torch.equal(before["actor.mu.weight"], after["actor.mu.weight"]))
    assert actors == [True, False, True, False]


def test_sb3_cannot_delay_the_actor():
    model = make_off_policy(network={"activation_fn": torch.nn.ELU})
    model.policy_delay = 2
    with pytest.raises(RecipeError, match="policy_delay: supported only for multi-layer perceptrons"):
        choose_update(model)
