"""`rlctl train --from`: weights and normalisation of a policy, where all of it fits."""

import numpy as np
import pytest

from rlctl.environments.spec import merge
from rlctl.errors import ArtifactError, UsageError
from rlctl.launching.train import run_training
from rlctl.policy.file import PolicyFile
from rlctl.policy.shipped import find_shipped_policy
from rlctl.runs.train_request import TrainRequest
from tests.training.comparing import rows
from tests.training.conftest import ENVS, TINY

LINE = f"{ENVS}:Line"


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A run of PPO on the line."""
    return run_training(TrainRequest(LINE, settings=TINY, root=tmp_path_factory.mktemp("runs"), check=False)).run


def assert_same_but_for_first_observations(begun, before):
    for name, values in before.items():
        # The observations of the first reset are in the statistics already.
        tolerance = 0.05 * np.abs(values).max() if name.startswith("normalize/") else 0.0
        np.testing.assert_allclose(begun[name], values, rtol=0.0, atol=tolerance)


@pytest.mark.slow
def test_begins_where_a_policy_ended(source, train, capfd):
    run = train("Line", {**TINY, "seed": 5}, initial_policy=str(source.path)).run
    policy = PolicyFile.read(source.best_policy)
    info, before = policy.info, policy.tensors
    begun = PolicyFile.read(run.policy_file("0")).tensors
    assert before.keys() == begun.keys()
    assert_same_but_for_first_observations(begun, before)
    after = PolicyFile.read(run.last_policy).tensors
    assert any((after[name] != values).any() for name, values in before.items())
    # 128 observations more, to those of the source: the statistics move, and not far.
    moved = np.abs(after["normalize//mean"] - before["normalize//mean"])
    assert (moved > 0).all()
    assert (moved < 3 * np.sqrt(before["normalize//var"])).all()
    assert run.status()["from"] == {
        "policy": str(source.best_policy), "task": LINE, "algo": "ppo", "training_steps": info.training_steps,
    }  # fmt: skip
    assert [row["steps"] for row in rows(run.evals_file)] == ["0", "128"]
    assert "its actor, critic and normalisation" in capfd.readouterr().err


@pytest.mark.slow
def test_a_shipped_actor_gets_a_fresh_critic(train, capfd):
    network = {"n_envs": 2, "total_timesteps": 32, "eval": {"episodes": 2, "every_steps": 1_000_000}}
    kwargs = {"algo_kwargs": {"n_steps": 16, "batch_size": 32, "n_epochs": 1}}
    result = train("reach", {**network, **kwargs}, initial_policy="reach")
    assert rows(result.run.evals_file)[0]["success"] == "1.0"  # at step 0
    shipped = PolicyFile.read(find_shipped_policy("reach")).tensors
    begun = PolicyFile.read(result.run.policy_file("0")).tensors
    assert_same_but_for_first_observations({name: begun[name] for name in shipped}, shipped)
    assert "it has no critic, so training starts with a new one: the first updates" in capfd.readouterr().err


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize(
    ("env", "settings", "kind", "message"),
    [
        (
            "Line",
            {"algo": "a2c", "algo_kwargs": None},
            UsageError,
            "the policy was trained with ppo, the recipe uses a2c; add",
        ),
        ("Discrete", {}, ArtifactError, "this policy is not for this task: its action space is"),
        (
            "Line",
            {"policy_kwargs": {"net_arch": [8]}},
            UsageError,
            r"its network differs: policy_kwargs.net_arch is {.*} in the policy and \[8\] in the recipe",
        ),
        (
            "Line",
            {"policy_kwargs": {"activation_fn": "relu"}},
            UsageError,
            "its network differs: policy_kwargs.activation_fn is tanh in the policy and relu in the recipe",
        ),
        (
            "Line",
            {"normalize": {"observation": False}},
            UsageError,
            "it normalises observations, and the recipe does not normalise them; add --set normalize.observation=true",
        ),
        ("Line", {"normalize": {"clip_observation": 5}}, UsageError, "it clips observations at 10, the recipe at 5;"),
    ],
)
def test_what_does_not_fit(source, train, tmp_path, env, settings, kind, message):
    given = {key: value for key, value in merge(TINY, settings).items() if value is not None}
    with pytest.raises(kind, match=message):
        train(env, given, initial_policy=str(source.best_policy))
    assert not list(tmp_path.glob("runs/*/2*"))


def test_what_is_no_source(train, resume, source):
    with pytest.raises(
        UsageError, match=r"ONNX files cannot be trained further; give the run or its \.safetensors file"
    ):
        train("Line", TINY, initial_policy="policy.onnx")
    with pytest.raises(ArtifactError, match="no run 'nothing'"):
        train("Line", TINY, initial_policy="nothing")
    with pytest.raises(UsageError, match="--from and --resume exclude each other"):
        run_training(TrainRequest(resume=str(source.path), initial_policy="reach", check=False))


@pytest.mark.slow
def test_the_warm_up_of_an_off_policy_algorithm_is_played_by_the_policy(train):
    sac = {"n_envs": 1, "total_timesteps": 40, "algo": "sac", "eval": {"episodes": 1, "every_steps": 1_000_000}}
    sac |= {"algo_kwargs": {"learning_starts": 30, "batch_size": 8}, "policy_kwargs": {"net_arch": [8]}}
    first = train("Line", sac)
    second = train("Line", {**sac, "total_timesteps": 20}, initial_policy=str(first.run.path))
    random = train("Line", {**sac, "total_timesteps": 20})
    terms = [[row["return"] for row in rows(each.run.metrics_file)] for each in (second, random)]
    assert terms[0] != terms[1]
