"""What the functions of a source assign, and what its names, parameters and calls stand for."""

import ast
import importlib

import gymnasium
import pytest

from rlctl.checking.assignments import list_assignments, list_values, peel, read_key, read_name
from rlctl.checking.definitions import Definitions, ReadExpression
from rlctl.checking.expressions import record_expressions
from rlctl.checking.source_code import SourceCode
from rlctl.checking.summands import RewardReader


class Slider(gymnasium.Env):
    def reset(self, *, seed=None, options=None):
        self.x, self.goal = 0.0, 1.0
        return self.x, {}

    @property
    def way(self):
        return self.goal - self.x

    def look(self):
        return self.x, abs(self.way)

    def pay(self, distance, scale=2.0):
        cost = float(distance)
        return -scale * cost

    def step(self, action):
        self.x += 0.1
        self.x = self.x + action - 0.05
        place, far = self.look()
        reward = self.pay(far, scale=3.0)
        for number, name in enumerate(["a", "b"]):
            reward += number * len(name)
        return place, reward, False, False, {}


@pytest.fixture(scope="module")
def definitions():
    env = Slider()
    source = SourceCode(env)
    with record_expressions(source) as recorder:
        with recorder.call(0) as begun:
            env.reset()
        with recorder.call(1) as stepped:
            env.step(0.0)
    return Definitions(source, [[begun, stepped]])


def read(text):
    return ast.parse(text, mode="eval").body


def find(definitions, function, text):
    nodes = [one for one in ast.walk(definitions.find_function(function)) if isinstance(one, ast.expr)]
    return next(
        one for one in nodes if ast.unparse(one) == text and not isinstance(getattr(one, "ctx", None), ast.Store)
    )


def test_assignments_of_a_function(definitions):
    found = [
        (ast.unparse(one.target), one.element, one.is_part, [(ast.unparse(part), sign) for part, sign in one.parts])
        for one in list_assignments(definitions.find_function("step"))
    ]
    assert found == [
        ("self.x", None, False, [("0.1", 1.0)]),
        ("self.x", None, False, [("action", 1.0), ("0.05", -1.0)]),
        ("place", 0, False, [("self.look()", 1.0)]),
        ("far", 1, False, [("self.look()", 1.0)]),
        ("reward", None, False, [("self.pay(far, scale=3.0)", 1.0)]),
        ("name", None, True, [("['a', 'b']", 1.0)]),
        ("reward", None, False, [("number * len(name)", 1.0)]),
    ]


def test_a_literal_tuple_is_assigned_element_by_element(definitions):
    reset = definitions.find_function("reset")
    assert [ast.unparse(one.value) for one in list_assignments(reset)] == ["0.0", "1.0"]
    assert [ast.unparse(one) for one in list_values(definitions.find_function("pay"), "cost")] == ["float(distance)"]


def test_names_elements_properties_and_calls_are_followed(definitions):
    step = definitions.find_function("step")
    far = definitions.follow(ReadExpression(find(definitions, "step", "far"), step))
    assert [ast.unparse(one.node) for one in far] == ["abs(self.way)"]
    walked = [ast.unparse(one.node) for one in definitions.walk(far[0])]
    assert "self.goal - self.x" in walked
    (paid,) = definitions.follow(ReadExpression(find(definitions, "step", "self.pay(far, scale=3.0)"), step))
    assert ast.unparse(definitions.resolve(paid.at(find(definitions, "pay", "scale"))).node) == "3.0"


def test_a_parameter_is_what_the_calls_give(definitions):
    origin = definitions.find_origin(find(definitions, "pay", "cost"), definitions.find_function("pay"))
    assert ast.unparse(origin) == "abs(self.way)"


def test_attributes_that_a_value_is_read_from_and_a_call_sets(definitions):
    look = definitions.find_function("look")
    assert definitions.list_reads(find(definitions, "look", "abs(self.way)"), look) == {"way", "goal", "x"}
    assert definitions.list_sets(definitions.find_function("reset")) == {"x", "goal"}


@pytest.mark.parametrize(
    ("text", "inner"),
    [
        ("np.asarray(x, np.float64)", "x"),
        ("x.astype(float)", "x"),
        ("np.copy(x)", "x"),
        ("copy.deepcopy(x)", "x"),
        ("float(x.copy()[:])", "x"),
        ("np.abs(x)", "np.abs(x)"),
    ],
)
def test_conversions(text, inner):
    assert ast.unparse(peel(read(text))) == inner


def test_names_and_keys():
    assert [read_name(read(text)) for text in ("a.b", "float(a.b)", "f(x)", "a['c'][0]")] == ["b", "b", "f", "c"]
    assert [read_key(read(text)) for text in ("self.a.b[0]", "a", "state['c']")] == ["a.b", "", "c"]


LINES = 40


def write_long_source(path):
    """Write functions that each call the eight next ones, and a reward of which each of many conditions leaves half."""
    calls = [f"self.h{i}()" for i in range(LINES + 8)]
    functions = [f"    def h{i}(self):\n        self.x{i} = {' + '.join(calls[i + 1 : i + 9])}\n" for i in range(LINES)]
    halves = [f"        if action > {i}:\n            reward = 0.5 * reward + self.x{i}\n" for i in range(LINES)]
    step = ["    def step(self, action):\n        reward = 0.0\n", *halves]
    end = "        self.h0()\n        return 0.0, reward, False, False, {}\n"
    path.write_text("".join(["import gymnasium\n\n\nclass Long(gymnasium.Env):\n", *functions, *step, end]))


def test_a_long_source_is_read_in_a_time_that_grows_with_its_length(tmp_path, monkeypatch):
    write_long_source(tmp_path / "long_source.py")
    monkeypatch.syspath_prepend(tmp_path)
    definitions = Definitions(SourceCode(importlib.import_module("long_source").Long()), [])
    (step,) = definitions.functions["step"]
    # Four calls deep, each function has the four after it and those that they call: 4 * 8 after h0.
    assert definitions.list_sets(step) == {f"x{i}" for i in range(3 * 8 + 1)}
    assert definitions.list_sets.cache_info().misses <= 4 * LINES
    assert len(RewardReader(definitions, [], {}).summands) > 1
