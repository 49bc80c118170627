"""The engine of a task: read once, stored as text."""

import dataclasses

import pydantic
import pytest

from rlctl.engine import MUJOCO, PYBULLET, Engine, read_engine
from rlctl.environments.spec import EnvChanges, EnvSpec, PolicySpec
from rlctl.errors import UsageError
from rlctl.recipe.recipe import Recipe


@pytest.mark.parametrize(
    ("text", "engine", "contact_time"),
    [("pybullet", PYBULLET, 0.02), ("mujoco", MUJOCO, 0.02), ("mujoco:0.005", Engine("mujoco", 0.005), 0.005)],
)
def test_engines(text, engine, contact_time):
    assert read_engine(text) == engine
    assert str(engine) == text
    assert engine.contact_time == contact_time


@pytest.mark.parametrize("text", ["mujoco:stiff", "mujoco:0", "mujoco:nan", "mujoco:", "pybullet:0.01", "bullet", ""])
def test_what_is_no_engine(text):
    with pytest.raises(UsageError, match="ive pybullet, mujoco, or mujoco:SOLREF with 0 < SOLREF < 1 s"):
        read_engine(text)


@pytest.mark.parametrize("text", ["", "pybullet", "mujoco", "mujoco:0.0123456789"])
def test_files_store_the_text(text):
    adapter = pydantic.TypeAdapter(PolicySpec)
    spec = adapter.validate_python({"task": "reach", "sim": text})
    assert str(spec.sim) == text
    assert adapter.dump_python(spec)["sim"] == adapter.dump_python(spec, mode="json")["sim"] == text
    assert adapter.validate_json(adapter.dump_json(spec)) == spec


def test_a_recipe_stores_the_text():
    recipe = Recipe(sim="mujoco:0.01")
    assert recipe.sim == Engine("mujoco", 0.01)
    assert "sim: mujoco:0.01\n" in recipe.to_yaml()
    assert Recipe.model_validate(recipe.model_dump()) == recipe


def test_an_engine_changes_nothing_else():
    spec = EnvSpec("reach", {"tolerance": 0.1}, {"action": 0.5}, randomize=True, events={"mass": {}}, frame_stack=2)
    assert EnvChanges(sim=MUJOCO).apply(spec) == dataclasses.replace(spec, sim=MUJOCO)
