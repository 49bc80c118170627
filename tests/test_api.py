"""The verbs from Python."""

import pytest

import rlctl
from rlctl.errors import ArtifactError, RecipeError, UsageError
from tests.training.conftest import ENVS, TINY


def test_what_there_is():
    assert {"check_env", "evaluate", "load_policy", "make", "train"} <= set(dir(rlctl))
    with pytest.raises(AttributeError, match=r"^module 'rlctl' has no attribute 'trian'$"):
        rlctl.trian  # noqa: B018


def test_train_and_evaluate_with_the_keys_of_a_recipe(tmp_path):
    settings = {**TINY, "total_timesteps": 64}
    result = rlctl.train(f"{ENVS}:Line", root=tmp_path / "runs", check=False, **settings)
    assert result.steps == 64
    evaluation = rlctl.evaluate(result.run.path, episodes=3, seed=4)
    assert [episode["index"] for episode in evaluation.episodes] == [0, 1, 2]
    assert all(not isinstance(value, dict | list) for episode in evaluation.episodes for value in episode.values())
    assert sum(episode["return"] for episode in evaluation.episodes) / 3 == pytest.approx(evaluation.returns.mean)
    assert repr(evaluation).startswith(f"Evaluation({ENVS}:Line, 3 episodes: ")
    assert repr(result) == f"TrainResult({ENVS}:Line, ppo, 64 steps, run {str(result.run.path)!r})"
    assert repr(rlctl.load_policy(result.run.path)) == f"Policy({ENVS}:Line, ppo, 64 steps)"
    assert rlctl.evaluate(result.run.path, episodes=3, seed=4).returns == evaluation.returns


def test_a_policy_that_is_not_there(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ArtifactError, match=r"^reeach: no such file.*Did you mean 'reach'\? .*'runs/latest'"):
        rlctl.load_policy("reeach")
    with pytest.raises(ArtifactError, match=r"^gone\.safetensors: no such file$"):
        rlctl.load_policy("gone.safetensors")


def test_keys_are_checked_as_on_the_command_line():
    with pytest.raises(RecipeError, match=r"no key 'n_env'\. Did you mean 'n_envs'\?"):
        rlctl.train("reach", n_env=3)
    with pytest.raises(RecipeError, match=r"^evaluate n_envs: only task\.NAME, "):
        rlctl.evaluate("reach", n_envs=3)
    for given in ({"episodes": 0}, {"seed": -1}):
        with pytest.raises(UsageError, match=r"^evaluate: episodes="):
            rlctl.evaluate("reach", **given)


@pytest.mark.slow
def test_check_env_returns_findings(write_module):
    bad = write_module(
        "bad.py",
        """
        import gymnasium, numpy as np
        from gymnasium.spaces import Box

        class Bad(gymnasium.Env):
            observation_space, action_space = Box(-1, 1, (2,)), Box(-1, 1, (1,))

            def reset(self, *, seed=None, options=None):
                return np.full(2, 7.0, np.float32), {}

            def step(self, action):
                return np.full(2, 7.0, np.float32), 0.0, False, True, {}
        """,
    )
    findings = rlctl.check_env(f"{bad}:Bad", select=["RL1", "RL2"])
    (outside,) = [finding for finding in findings if finding.name == "observation out of range"]
    assert outside.severity == "error"
    assert str(outside).startswith(f"{outside.rule} error (observation out of range): ")
    assert rlctl.check_env(f"{bad}:Bad", select=["RL2", "RL1"], ignore=[outside.rule]) == [
        finding for finding in findings if finding.rule != outside.rule
    ]
    with pytest.raises(UsageError, match=r"^no task 'reech'"):
        rlctl.check_env("reech")


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_policy_is_evaluated_on_another_task():
    with pytest.raises(UsageError, match=r"^evaluate: task must be the name of a task, got {'tolerance': 0.1}; "):
        rlctl.evaluate("reach", task={"tolerance": 0.1})
    easy = rlctl.evaluate("reach", checkpoint="pretrained", episodes=2, parameters={"tolerance": 0.2})
    assert easy.spec.parameters["tolerance"] == 0.2
    other = rlctl.evaluate("reach", checkpoint="pretrained", episodes=1, task="rlctl_manipulation.reach:Reach")
    assert other.spec.task == "rlctl_manipulation.reach:Reach"
