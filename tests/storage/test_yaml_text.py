"""YAML as people mean it."""

import math

import pytest

from rlctl.errors import RecipeError
from rlctl.storage import yaml_text


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3e-4", 3e-4),
        ("1e6", 1e6),
        ("1.e3", 1000.0),
        (".5", 0.5),
        ("-2.5E+3", -2500.0),
        ("200_000", 200_000),
        ("1_000.5", 1000.5),
        ("010", 10),
        ("0o17", 15),
        ("0x1F", 31),
        ("-7", -7),
        ("-.inf", -math.inf),
        ("on", "on"),
        ("yes", "yes"),
        ("1:30", "1:30"),
        ("2020-01-01", "2020-01-01"),
        ("true", True),
        ("False", False),
        ("null", None),
        ("~", None),
        ("", None),
        ("'3e-4'", "3e-4"),
        ("e5", "e5"),
        ("1.2.3", "1.2.3"),
    ],
)
def test_scalars(text, value):
    loaded = yaml_text.load(f"key: {text}", "recipe.yaml")["key"]
    assert loaded == value
    assert type(loaded) is type(value)


def test_not_a_number():
    assert math.isnan(yaml_text.load(".nan", "recipe.yaml"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3\n", "recipe.yaml:3: key 'a' is given twice"),
        ("a:\n  b: 1\n  b: 2\n", "recipe.yaml:3: key 'b' is given twice"),
        ("a: [1\n", "recipe.yaml:2: expected ',' or ']', but got '<stream end>'"),
        ("a:\tb: c", "recipe.yaml:1: a tab: indent and separate with spaces"),
        ("a:\n\tb: c", "recipe.yaml:2: a tab: indent and separate with spaces"),
    ],
)
def test_errors_have_their_line(text, message):
    with pytest.raises(RecipeError) as caught:
        yaml_text.load(text, "recipe.yaml")
    assert str(caught.value) == message


def test_no_code_is_run():
    with pytest.raises(RecipeError, match=r"^recipe.yaml:1: tags \(!!int, !name\) are not supported"):
        yaml_text.load("a: !!python/object/apply:os.getcwd []", "recipe.yaml")


@pytest.mark.parametrize(
    "value", ["1e6", "3e-4", "0o17", "010", "on", "yes", "1:30", "~", "", "null", "1_0", 1e-5, 1e16, math.inf, None, 7]
)
def test_what_is_written_is_read_as_it_was(value):
    loaded = yaml_text.load(yaml_text.dump({"key": value}), "recipe.yaml")["key"]
    assert loaded == value
    assert type(loaded) is type(value)
