"""Stages in recipes: what is accepted, what is refused and how, and what the environments are made from."""

import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import RecipeError
from rlctl.recipe.recipe import validate
from rlctl.recipe.sources import resolve
from rlctl.recipe.stages import format_value
from rlctl.storage import yaml_text

RULE = {"success": 0.8, "window": 100}


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        (
            [{"task": {"tolerance": 0.2}}, {}],
            "recipe: stages: stage 1 of 2 (tolerance 0.2) has no promotion rule, so it would never end; "
            "add promote: {success: 0.8, window: 100} or promote: {return: 50.0, window: 100}",
        ),
        (
            [{"promote": RULE}, {"promote": RULE}],
            "recipe: stages: stage 2 of 2 (the recipe's own task) is the last: remove its promote",
        ),
        (
            [{"promot": RULE}, {}],
            "recipe: stage 1: no key 'promot'. Did you mean 'promote'? "
            "Keys here: task, reward_weights, events, level, promote.",
        ),
        (
            [{"promote": RULE}, {"promote": {"sucess": 0.8}}, {}],
            "recipe: stage 2: no key 'promote.sucess'. Did you mean 'success'? "
            "Keys here: success, return, window, min_steps.",
        ),
        (
            [{"promote": {**RULE, "return": 1.0}}, {}],
            "recipe: stage 1: promote: give one of success and return: promote: {success: 0.8, window: 100}",
        ),
        (
            [{"promote": {"window": 9}}, {}],
            "recipe: stage 1: promote: give one of success and return: promote: {success: 0.8, window: 100}",
        ),
        (
            [{"promote": {"success": 80}}, {}],
            "recipe: stage 1: promote.success: expected a number in (0, 1] or null, got 80",
        ),
        (
            [{"promote": {**RULE, "window": 0}}, {}],
            "recipe: stage 1: promote.window: expected a whole number in [1, 1e6], got 0",
        ),
        ([5], "recipe: stage 1: expected a mapping of task, reward_weights, events, level, promote, got 5"),
        (
            {"task": {}},
            "recipe: stages: expected a list, each element a mapping of task, reward_weights, events, level, promote, "
            "got {'task': {}}",
        ),
    ],
)
def test_refused_stages_are_named(stages, message):
    with pytest.raises(RecipeError) as caught:
        validate({"stages": stages}, "recipe")
    assert str(caught.value) == message


def test_each_stage_changes_the_recipe_and_not_the_stage_before_it():
    recipe = validate(
        {
            "task": {"tolerance": 0.05, "speed": 1.0},
            "reward_weights": {"action": -0.1},
            "events": {"mass": {"factor": [0.9, 1.1]}},
            "stages": [
                {"task": {"tolerance": 0.2}, "events": {"mass": {"factor": [1.0, 1.0]}}, "promote": RULE},
                {"reward_weights": {"reached": 2.0}, "promote": {"return": 50}},
                {},
            ],
        },
        "recipe",
    )
    first, second, last = recipe.env_specs("any")
    own = {"tolerance": 0.05, "speed": 1.0}, {"action": -0.1}, False, {"mass": {"factor": [0.9, 1.1]}}
    assert first.parameters == {"tolerance": 0.2, "speed": 1.0}
    assert first.events == {"mass": {"factor": [1.0, 1.0]}}
    assert second.parameters == own[0]
    assert second.reward_weights == {"action": -0.1, "reached": 2.0}
    assert last == EnvSpec("any", *own, stage=3)
    assert [str(stage) for stage in recipe.stages] == [
        "tolerance 0.2, mass.factor [1.0, 1.0]",
        "reward_weights.reached 2",
        "the recipe's own task",
    ]


def test_without_stages_there_is_one_environment():
    assert validate({"task": {"a": 1}}, "recipe").env_specs("any") == [EnvSpec("any", {"a": 1})]


def test_ranges_widen_with_the_level_of_the_stage():
    widening = {"mass": {"factor": {"from": [1.0, 1.0], "to": [1.5, 1.5]}}}
    stages = [{"level": 0.0, "promote": RULE}, {"level": 0.5, "promote": RULE}, {}]
    recipe = validate({"events": widening, "stages": stages}, "recipe")
    assert [str(stage) for stage in recipe.stages] == ["level 0", "level 0.5", "the recipe's own task"]
    drawn = []
    for spec in recipe.env_specs("reach"):
        env = spec.make()
        drawn.append(env.reset(seed=0)[1]["events"]["mass"]["factor"])
        env.close()
    assert drawn == [1.0, 1.25, 1.5]
    with pytest.raises(
        RecipeError, match=r"^level: Pendulum-v1 is a plain Gymnasium environment; only tasks have them"
    ):
        EnvSpec("Pendulum-v1", level=0.5).make()


def test_stages_survive_yaml():
    recipe = validate({"stages": [{"task": {"a": 1}, "promote": {"return": 5.0}}, {}]}, "recipe")
    assert validate(yaml_text.load(recipe.to_yaml(), "it"), "it") == recipe


def test_the_recipe_goes_over_the_stages_of_the_task():
    declared = ({"task": {"a": 1}, "promote": RULE}, {})
    assert [stage.task for stage in resolve("a.py:A", None, {}, declared).stages] == [{"a": 1}, {}]
    assert resolve("a.py:A", None, {"stages": []}, declared).stages == []
    with pytest.raises(RecipeError, match=r"^class of a.py:A: stages: stage 1 of 2 .* has no promotion rule"):
        resolve("a.py:A", None, {}, ({}, {}))


def test_what_stages_change_as_text():
    stages = [{"task": {"tolerance": 0.2}, "level": 1.0, "promote": RULE}, {"reward_weights": {"effort": 0.5}}, {}]
    assert format_value("stages", stages) == (
        "3 stages: tolerance 0.2; reward_weights.effort 0.5; the recipe's own task"
    )
    assert format_value("stages", []) == "[]"
    assert format_value("stages", "(not set)") == "(not set)"
    assert format_value("n_envs", 8) == "8"
