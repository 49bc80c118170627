"""Usual ranges of hyperparameters."""

from pathlib import Path

import pytest

from rlctl.environments.installed import list_installed
from rlctl.launching.findings import warn_of_unusual_values
from rlctl.recipe import recipe_files, sources
from rlctl.runs.diagnosis import usual_ranges
from rlctl.runs.train_request import TrainRequest

RECIPES = [(entry.name, None) for entry in list_installed()]
RECIPES += [("reach", Path(preset)) for preset in recipe_files.list_presets()]


@pytest.mark.parametrize(("task", "config"), RECIPES)
def test_no_packaged_recipe_is_unusual(task, config):
    recipe = sources.resolve(task, config, {})
    assert usual_ranges.find_far_out(recipe.algo_kwargs, recipe.algo, recipe.n_envs) == []


@pytest.mark.parametrize(
    ("algo", "n_envs", "values", "far_out"),
    [
        ("ppo", 8, {"gamma": 0.2, "learning_rate": 0.1}, ["learning_rate", "gamma"]),  # 100 and 8 times out
        ("ppo", 8, {"gamma": 0.8}, []),  # 5 steps, half of the usual 10
        ("ppo", 8, {"gamma": 1.0}, []),  # rewards count up to the end of the episode
        ("ppo", 1, {"n_steps": 24}, ["n_steps"]),
        ("ppo", 4096, {"n_steps": 24, "batch_size": 24576}, []),
        ("ppo", 8, {"batch_size": 24576}, ["batch_size"]),  # 12 times 8 x 256
        ("a2c", 8, {"n_steps": 5}, []),  # which is usual for it
        ("ppo", 8, {"ent_coef": 0.0, "target_kl": None}, []),
        ("ppo", 8, {"learning_rate": "lin_0.03"}, ["learning_rate"]),
    ],
)
def test_values_that_are_far_out(algo, n_envs, values, far_out):
    assert [setting.name for setting in usual_ranges.find_far_out(values, algo, n_envs)] == far_out


def test_a_training_warns_of_unusual_values_that_were_given(tmp_path):
    config = tmp_path / "own.yaml"
    config.write_text("algo_kwargs: {gamma: 0.2}\n")
    request = TrainRequest(task="reach", config=config, settings={"algo_kwargs": {"learning_rate": 0.1}})
    recipe = sources.resolve("reach", request.config, request.settings)
    assert warn_of_unusual_values(request, recipe) == [
        "warning: learning_rate 0.1: usually 1e-5 to 1e-3; lower it: steadier, slower",
        "warning: gamma 0.2: usually 0.9 to 0.9999; the policy then sees about 1 step ahead",
    ]
    assert warn_of_unusual_values(TrainRequest(task="reach"), sources.resolve("reach", None, {})) == []
