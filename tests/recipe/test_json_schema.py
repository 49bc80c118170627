"""The schema of recipes for editors takes every recipe that rlctl takes, and names the mistakes."""

import json
from pathlib import Path

import jsonschema
import pytest

from rlctl.recipe.recipe import ALGORITHMS, SCHEMA_FILE
from rlctl.storage import yaml_text

ROOT = Path(__file__).parents[2]
RECIPES = [
    *ROOT.glob("plugins/*/*.yaml"),
    *ROOT.glob("rlctl/recipe/presets/*.yaml"),
    *(file for file in ROOT.glob("examples/*/*.yaml") if file.name != "limits.yaml"),
]
VALIDATOR = jsonschema.Draft7Validator(json.loads(SCHEMA_FILE.read_text()))


@pytest.mark.parametrize("file", RECIPES, ids=lambda file: file.stem)
def test_recipes_are_valid(file):
    content = yaml_text.load(file.read_text(), str(file))
    assert [error.message for error in VALIDATOR.iter_errors(content)] == []


@pytest.mark.parametrize(
    ("recipe", "place"),
    [
        ({"n_env": 3}, []),
        ({"n_envs": 0}, ["n_envs"]),
        ({"n_envs": "many"}, ["n_envs"]),
        ({"algo": "pp"}, ["algo"]),
        ({"algo_kwargs": {"tau": 0.1}}, ["algo_kwargs"]),  # ppo has none
        ({"algo": "sac", "algo_kwargs": {"n_steps": "no"}}, ["algo_kwargs", "n_steps"]),
        ({"policy_kwargs": {"activation_fn": "sine"}}, ["policy_kwargs", "activation_fn"]),
        ({"callbacks": ["my.py:Patience"]}, ["callbacks"]),
    ],
)
def test_mistakes_are_found(recipe, place):
    assert place in [list(error.path) for error in VALIDATOR.iter_errors(recipe)]


def test_classes_of_the_user_are_valid():
    own = {"activation_fn": "torch.nn:Mish", "policy_class": "my_nets.py:Own", "net_arch": [8]}
    extractor = {"features_extractor_class": "my_nets.py:Gated", "features_extractor_kwargs": {"heads": 3}}
    recipe = {"policy_kwargs": {**own, **extractor}, "callbacks": {"my.py:Patience": {"factor": 0.5}, "mine:Log": None}}
    for algo in ALGORITHMS:
        assert [error.message for error in VALIDATOR.iter_errors({**recipe, "algo": algo})] == []


def test_what_each_algorithm_has():
    assert VALIDATOR.is_valid({"algo": "sac", "algo_kwargs": {"tau": 0.1}})
    assert VALIDATOR.is_valid({"total_timesteps": "200_000"})
    jsonschema.Draft7Validator.check_schema(VALIDATOR.schema)


def test_the_command(rlctl):
    assert json.loads(rlctl("recipe", "--schema").stdout) == VALIDATOR.schema
    assert yaml_text.load(rlctl("recipe", "reach").stdout, "recipe")["algo"] == "ppo"
    assert rlctl("recipe").stderr == "error: give a task, such as rlctl recipe reach, or --schema\n"


def test_a_recipe_has_no_path_of_this_machine(tmp_path):
    from rlctl.recipe.recipe import Recipe
    from rlctl.runs.directory import RunDirectory

    run = RunDirectory(tmp_path)
    run.write_recipe(Recipe())
    line, _, _ = run.recipe_file.read_text().partition("\n")
    assert line == "# yaml-language-server: $schema=recipe.schema.json"
    assert json.loads((tmp_path / "recipe.schema.json").read_text()) == VALIDATOR.schema
    assert run.recipe() == Recipe()
