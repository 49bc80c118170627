"""The verbs from Python."""

import pytest

import rlctl
from rlctl.errors import RecipeError, UsageError
from tests.training.conftest import ENVS, TINY


def test_what_there_is():
    assert {"evaluate", "load_policy", "make", "train"} <= set(dir(rlctl))
    with pytest.raises(AttributeError, match=r"^module 'rlctl' has no attribute 'trian'$"):
        rlctl.trian  # noqa: B018


def test_train_and_evaluate_with_the_keys_of_a_recipe(tmp_path):
    settings = {**TINY, "total_timesteps": 64}
    result = rlctl.train(f"{ENVS}:Line", root=tmp_path / "runs", check=False, **settings)
    assert result.steps == 64
    evaluation = rlctl.evaluate(result.run.path, episodes=3, seed=4)
    assert len(evaluation.episodes) == 3
    assert rlctl.evaluate(result.run.path, episodes=3, seed=4).returns == evaluation.returns


def test_keys_are_checked_as_on_the_command_line():
    with pytest.raises(RecipeError, match=r"no key 'n_env'\. Did you mean 'n_envs'\?"):
        rlctl.train("reach", n_env=3)
    with pytest.raises(RecipeError, match=r"^evaluate n_envs: only task\.NAME, "):
        rlctl.evaluate("reach", n_envs=3)
    for given in ({"episodes": 0}, {"seed": -1}):
        with pytest.raises(UsageError, match=r"^evaluate: episodes="):
            rlctl.evaluate("reach", **given)
