"""What rows of metrics say of actions, by hand."""

import dataclasses

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import DQN, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.training.measurements import (
    LastSteps,
    collect_histograms,
    estimate_values,
    recent_gradient_norm,
    summarize_steps,
)


def play(actions, done=(), terminated=()):
    """Make steps of one environment; `done` and `terminated` are numbers of steps."""
    actions = np.array(actions, np.float64).reshape(1, -1, 1)
    ended, by_task = (np.isin(np.arange(actions.shape[1]), each).reshape(1, -1) for each in (done, terminated))
    return LastSteps({"": np.zeros((*actions.shape[:2], 3))}, actions, by_task, ended & ~by_task, None)


LINE = spaces.Box(-2.0, 2.0, (1,))


def test_actions():
    row = summarize_steps(play([1.0, -1.0, 0.5, 0.5], done=[1]), LINE, {})
    assert row["action_saturation"] == 0.5  # in half ranges; two of four are at a limit
    # Changes of 2 and 0; that from -1 to 0.5 is from one episode to the next.
    assert row["action_change"] == 1.0
    assert row["terminated"] == 0.0
    assert row["value"] is None


def test_share_of_terminated_episodes():
    row = summarize_steps(play([0.0] * 4, done=[0, 1, 3], terminated=[1]), LINE, {})
    assert row["terminated"] == pytest.approx(1 / 3)
    assert summarize_steps(play([0.0] * 4), LINE, {})["terminated"] is None


def test_exploration_is_the_deviation_that_has_the_entropy():
    # The entropy of a normal distribution with deviation 0.3 is ln(0.3 sqrt(2 pi e)); the half range is 2.
    entropy = np.log(0.3 * np.sqrt(2 * np.pi * np.e))
    assert summarize_steps(None, LINE, {"train/entropy_loss": -entropy})["exploration"] == pytest.approx(0.15)
    # Of four actions, two are as likely as each other: ln 2.
    row = summarize_steps(None, spaces.Discrete(4), {"train/entropy_loss": -np.log(2)})
    assert row["exploration"] == pytest.approx(0.5)
    assert summarize_steps(None, LINE, {})["exploration"] is None


def test_an_off_policy_actors_loss_is_minus_the_value():
    assert summarize_steps(None, LINE, {"train/actor_loss": 3.0})["value"] == -3.0


def test_adam_remembers_how_large_gradients_were():
    parameter = torch.nn.Parameter(torch.zeros(2))
    optimizer = torch.optim.Adam([parameter], lr=0.1)
    assert recent_gradient_norm(optimizer) is None
    for sign in (1.0, -1.0, 1.0):
        parameter.grad = sign * torch.tensor([3.0, 4.0])
        optimizer.step()
    assert recent_gradient_norm(optimizer) == pytest.approx(5.0, rel=1e-4)


def test_observations_have_histograms_by_name():
    names = EnvInfo(
        observation_space=space_to_json(spaces.Box(-9.0, 9.0, (3,))),
        action_space=space_to_json(LINE),
        observation_sizes={"joint_positions": 2, "height": 1},
        observation_units={"joint_positions": "rad"},
    )
    steps = play([0.0] * 5)
    found = collect_histograms(steps, names)
    assert {name: tuple(values.shape) for name, values in found.items()} == {
        "histograms/actions": (5,),
        "histograms/joint_positions": (10,),
        "histograms/height": (5,),
    }
    # Pictures and what has no name have none.
    picture = {"camera": np.zeros((1, 5, 4, 4, 3), np.uint8)}
    for nameless in (steps, dataclasses.replace(steps, observation=picture)):
        assert collect_histograms(nameless, names.model_copy(update={"observation_sizes": {}})).keys() == {
            "histograms/actions"
        }


@pytest.mark.parametrize(("algorithm", "env"), [(SAC, "Pendulum-v1"), (TQC, "Pendulum-v1"), (DQN, "CartPole-v1")])
def test_the_values_of_an_off_policy_critic(algorithm, env):
    venv = VecNormalize(DummyVecEnv([lambda: gymnasium.make(env)]), norm_reward=False)
    model = algorithm("MlpPolicy", venv, buffer_size=10, device="cpu", policy_kwargs={"net_arch": [8]})
    venv.obs_rms.mean[:] = 1.0
    rng, discrete = np.random.default_rng(0), algorithm is DQN
    observation = rng.normal(size=(2, 4, *venv.observation_space.shape)).astype(np.float32)
    action = np.arange(8).reshape(2, 4, 1) % 2 if discrete else rng.uniform(-1, 1, (2, 4, 1)).astype(np.float32)
    never = np.zeros((2, 4), bool)
    values = estimate_values(model, LastSteps({"": observation}, action, never, never, None))
    assert values.shape == (8,)
    last = torch.as_tensor((observation[1, 3:] - 1.0) / np.sqrt(1 + 1e-8))  # of step 4 of environment 2, normalised
    with torch.no_grad():
        if discrete:
            expected = model.q_net(last)[0, 1]
        else:
            expected = torch.stack(tuple(model.critic(last, torch.as_tensor(action[1, 3:])))).mean()
    assert values[7] == pytest.approx(float(expected), rel=1e-5)
