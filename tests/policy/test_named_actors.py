"""Policies that need no training: what they play, and what a user's function may do wrong."""

import numpy as np
import pytest
from gymnasium import spaces

from rlctl.errors import PolicyError, UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import run_evaluation
from rlctl.evaluation.report import as_json
from rlctl.policy.actor import Rows
from rlctl.policy.named_actors import load_function, make_actor

BOX = spaces.Box(-1.0, 1.0, (2,), np.float32)
FUNCTIONS = """
    import numpy as np
    def to_goal(observation): return [3.0, -0.5]
    def of_another_shape(observation): return [1.0]
    def nothing(observation): pass
    def not_a_number(observation): return [float("nan"), 0.0]
    def raises(observation): raise KeyError("hand")
    def changes(observation): observation[:] = 9.0; return [0.0, 0.0]
    def seven(observation): return np.ones(7)
    def of_step(observation, step): return [step / 10, 0.0]
    def of_time(observation, time): return [time / 10, 0.0]
    def of_optional_step(observation, step=9): return [step / 10, 0.0]
    def with_gain(observation, gain=0.25): return [gain, 0.0]
    def of_three(a, b, c): return [0.0, 0.0]
    def leaves(observation): raise SystemExit(2)
"""


@pytest.fixture
def functions(write_module):
    return write_module("functions.py", FUNCTIONS)


def act(name, space, observation=None, step=0):
    observation = np.zeros(3) if observation is None else observation
    return make_actor(str(name), space).act(observation[None], Rows.one(1, step))[1][0]


def test_zero():
    assert act("zero", BOX).tolist() == [0.0, 0.0]
    assert act("zero", spaces.Box(1.0, 2.0, (1,))).tolist() == [1.0]  # 0 is outside; the nearest
    assert act("zero", spaces.Discrete(3, start=5)) == 5
    assert act("zero", spaces.MultiBinary(2)).tolist() == [0, 0]


def test_random_follows_from_the_seed_and_the_step():
    actor, rows = make_actor("random", spaces.Discrete(1000)), Rows(np.arange(3), np.ones(3, int), np.array([0, 0, 1]))
    first, same, other = actor.act(np.zeros((3, 2)), rows)[1].tolist()
    assert first == same != other


def test_random_does_not_touch_the_random_numbers_of_the_environment():
    space = spaces.Discrete(1000, seed=7)
    expected = spaces.Discrete(1000, seed=7).sample()
    make_actor("random", space).act(np.zeros((1, 2)), Rows.one())
    assert space.sample() == expected


def test_a_function_acts_within_the_space(functions):
    assert act(f"{functions}:to_goal", BOX).tolist() == [1.0, -0.5]
    observation = np.zeros(3)
    act(f"{functions}:changes", BOX, observation)
    assert observation.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("name", "first"), [("of_step", 0.5), ("of_time", 0.5), ("of_optional_step", 0.5), ("with_gain", 0.25)]
)
def test_a_function_may_take_the_step(functions, name, first):
    assert act(f"{functions}:{name}", BOX, step=5).tolist() == [first, 0.0]


def test_a_function_of_three_arguments_is_refused_at_once(functions):
    with pytest.raises(
        UsageError, match=r"its parameters are \(a, b, c\); write \(observation\) or \(observation, step\)"
    ):
        load_function(f"{functions}:of_three")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "of_another_shape",
            r"it returned shape \(1,\), expected \(2,\): \[1.0\]; the action space is Box\(-1.0, 1.0, \(2,\)",
        ),
        ("nothing", "it returned None; the action space is Box"),
        ("not_a_number", r"it returned \[nan, 0.0\]; the action space is Box"),
        ("raises", r"KeyError: 'hand' \(functions.py, line 7\)$"),
        ("leaves", r"SystemExit: 2 \(functions.py, line 15\)$"),
    ],
)
def test_what_a_function_does_wrong(functions, name, message):
    with pytest.raises(PolicyError, match=rf"^policy functions.py:{name}, step 4: {message}") as caught:
        act(f"{functions}:{name}", BOX, step=4)
    assert caught.value.exit_code == 3
    assert "\n" not in str(caught.value)
    assert caught.value.details is None  # no traceback: the line is in the message


def test_a_discrete_action_is_one_of_the_space(functions):
    with pytest.raises(PolicyError, match="the action space is Discrete"):
        act(f"{functions}:to_goal", spaces.Discrete(2))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("zeros", "--policy zeros: give zero, random, MODULE:FUNCTION or PATH.py:FUNCTION. Did you mean 'zero'?"),
        ("nowhere.py:act", "--policy nowhere.py:act: no file "),
        ("no_such_module:act", "--policy no_such_module:act: no module 'no_such_module' is installed or under "),
    ],
)
def test_text_that_names_no_function(text, message):
    with pytest.raises(UsageError) as caught:
        load_function(text)
    assert str(caught.value).startswith(message)


def test_a_function_that_is_not_there(functions):
    with pytest.raises(UsageError, match=r"functions\.py has no function 'acts'"):
        load_function(f"{functions}:acts")


@pytest.mark.slow
def test_a_baseline_is_evaluated_as_a_policy_is(functions):
    zero = run_evaluation(EvalRequest("reach", baseline="zero", episodes=2))
    assert zero.lengths.mean == 120
    assert as_json(zero)["policy"] == {"baseline": "zero"}
    ones = run_evaluation(EvalRequest("reach", baseline=f"{functions}:seven", episodes=2))
    assert [episode["seed"] for episode in ones.episodes] == [episode["seed"] for episode in zero.episodes]
    assert ones.returns.mean != zero.returns.mean
    with pytest.raises(PolicyError, match=r"\(7,\), float32\)\nin environment 0, episode seed \d+, step 0$"):
        run_evaluation(EvalRequest("reach", baseline=f"{functions}:to_goal", episodes=1))


def test_what_a_baseline_does_not_take():
    with pytest.raises(UsageError, match="not a run: leave out --checkpoint, --pretrained"):
        run_evaluation(EvalRequest("reach", baseline="zero", checkpoint="pretrained"))
    with pytest.raises(UsageError, match="give the task to play: rlctl eval reach --policy zero"):
        run_evaluation(EvalRequest(None, baseline="zero"))
    with pytest.raises(
        UsageError, match=r"plays a task, and best\.onnx is a file: leave out --policy, or name its task"
    ):
        run_evaluation(EvalRequest("best.onnx", baseline="zero"))


def test_random_leaves_the_generator_of_the_environment_alone():
    space = spaces.Box(-1.0, 1.0, (2,))
    space.seed(3)
    before = space.np_random.bit_generator.state
    make_actor("random", space).act(np.zeros((1, 1)), Rows.one(seed=1, step=2))
    assert space.np_random.bit_generator.state == before
