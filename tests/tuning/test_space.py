"""What `rlctl tune` searches: keys, ranges and choices, and what it searches unasked."""

import pytest

from rlctl.errors import UsageError
from rlctl.recipe.recipe import Recipe
from rlctl.recipe.sources import fill_defaults, resolve_with_stages
from rlctl.tuning.space import Dimension, get_value, list_usual_steps, nest, parse_search


@pytest.mark.parametrize(
    ("text", "dimension"),
    [
        ("algo_kwargs.gamma=0.9,0.99", Dimension("algo_kwargs.gamma", choices=(0.9, 0.99))),
        ("policy_kwargs.net_arch=[64, 64],[256]", Dimension("policy_kwargs.net_arch", choices=([64, 64], [256]))),
        ("algo=ppo,sac", Dimension("algo", choices=("ppo", "sac"))),
        ("algo_kwargs.gamma=0.9:0.99", Dimension("algo_kwargs.gamma", low=0.9, high=0.99)),
        ("n_envs=2:16", Dimension("n_envs", low=2, high=16, whole=True)),
        (
            "algo_kwargs.learning_rate=lin_1e-4:lin_1e-2",
            Dimension("algo_kwargs.learning_rate", low=1e-4, high=1e-2, prefix="lin_"),
        ),
    ],
)
def test_a_search(text, dimension):
    assert parse_search([text]) == [dimension]


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["gamma"], "--search 'gamma': write KEY=LOW:HIGH or KEY=A,B,C"),
        (["algo_kwargs.gamma=0.9"], "--search 'algo_kwargs.gamma=0.9': a search needs two values or more"),
        (["algo_kwargs.gamma=0.9:0.8"], "--search 'algo_kwargs.gamma=0.9:0.8': not a range"),
        (["algo_kwargs.gamma=1e-4:lin_1"], "--search 'algo_kwargs.gamma=1e-4:lin_1': not a range"),
        (["algo_kwargs.gamma=a:b"], "--search 'algo_kwargs.gamma=a:b': a and b must be numbers"),
        (["n_envs=1,2", "n_envs=3,4"], "--search: n_envs is given twice"),
    ],
)
def test_what_is_no_search(texts, message):
    with pytest.raises(UsageError) as caught:
        parse_search(texts)
    assert str(caught.value).startswith(message)


def test_what_is_drawn_and_what_the_recipe_gets():
    rate = Dimension("algo_kwargs.learning_rate", low=1e-5, high=1e-3, prefix="lin_")
    assert rate.make_distribution().log
    assert rate.to_value(0.00012345) == "lin_0.000123"
    assert rate.from_value("lin_0.000123") == 0.000123
    assert rate.from_value("lin_0.1") is None
    count = Dimension("n_envs", low=2, high=4, whole=True)
    assert (count.to_value(3), count.from_value(4), count.ends()) == (3, 4, [2, 4])
    choice = Dimension("algo_kwargs.gamma", choices=(0.9, 0.99))
    assert (choice.to_value(1), choice.from_value(0.9), choice.from_value(0.5)) == (0.99, 0, None)


def keys(steps):
    return [[each.name for each in step] for step in steps]


def test_the_usual_ladder_is_around_the_recipe():
    recipe = resolve_with_stages("reach")
    steps = list_usual_steps(recipe)
    assert keys(steps) == [["learning_rate"], ["n_steps", "batch_size"], ["gamma"]]
    for dimension in (each for step in steps for each in step):
        assert dimension.from_value(get_value(recipe.model_dump(), dimension.key)) is not None
    rollout = recipe.algo_kwargs["n_steps"] * recipe.n_envs
    assert max(steps[1][1].choices) <= rollout


@pytest.mark.parametrize(
    ("algo", "second"), [("sac", ["n_steps", "batch_size"]), ("dqn", ["n_steps", "batch_size"]), ("a2c", ["n_steps"])]
)
def test_the_usual_ladder_of_other_algorithms(algo, second):
    recipe = fill_defaults(Recipe(algo=algo))
    assert keys(list_usual_steps(recipe)) == [["learning_rate"], second, ["gamma"]]


def test_a_falling_learning_rate_goes_on_falling():
    recipe = fill_defaults(Recipe(algo="sac", algo_kwargs={"learning_rate": "lin_1e-3"}))
    assert list_usual_steps(recipe)[0][0].ends() == ["lin_0.0001", "lin_0.01"]


def test_dotted_keys():
    values = {"algo_kwargs.gamma": 0.9, "algo_kwargs.tau": 0.1, "n_envs": 2}
    assert nest(values) == {"algo_kwargs": {"gamma": 0.9, "tau": 0.1}, "n_envs": 2}
    assert [get_value(nest(values), key) for key in (*values, "no.such")] == [0.9, 0.1, 2, None]
