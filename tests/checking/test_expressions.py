"""What the expressions of a source are worth while it runs, and the times that it adds up and divides by."""

import functools
import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from rlctl.checking.child import TOO_DEEP
from rlctl.checking.experiment import PROBE
from rlctl.checking.expressions import record_expressions
from rlctl.checking.records import Finished, Skipped
from rlctl.checking.source_code import SourceCode
from rlctl.checking.step_times import StepTimes
from rlctl.checking.timed_expressions import Use, find_majority, find_timed_expressions
from tests.checking.judging import run_here

DT, SUBSTEPS = 0.1, 5
H = DT / SUBSTEPS


def decorated(function):
    @functools.wraps(function)
    def call(*arguments):
        return function(*arguments)

    return call


@decorated
def double(value):
    return 2 * value


class Base(gymnasium.Env):
    def place(self):
        return self.x + 1


class Cart(Base):
    """All that a replaced code has to keep: closures, `super`, a property, comprehensions, an f-string, a lambda."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.v, self.t, self.air, self.last = 0.0, 1.0, 0.0, np.zeros(2), 0.0
        return self.x, {}

    @property
    def fast(self):
        return self.v > 0.5 and self.x >= 0

    def place(self):
        return super().place() * 1.0

    def step(self, action):
        for _ in range(SUBSTEPS):
            self.x += self.v * H
        self.t += DT
        for leg in range(2):
            self.air[leg] += DT
        speed = (self.x - self.last) / DT
        self.last = self.x
        offset = 3.0

        def shifted(value):
            return value + offset

        total = sum([shifted(one) for one in self.air if one > 0]) + double(self.place())
        first, *_rest = (speed, f"{self.t:.2f}", (lambda: self.x)())
        return (self.x, float(total), bool(self.fast), False, {"first": first})


Wagon = Cart  # an older name for the same class


def play(env, steps=30):
    source = SourceCode(env)
    calls = []
    with record_expressions(source) as recorder:
        with recorder.call(0) as noted:
            env.reset(seed=0)
        calls.append(noted)
        for step in range(steps):
            env.v = 1.0 + 0.1 * step
            with recorder.call(step + 1) as noted:
                env.step(0.0)
            calls.append(noted)
    return source, calls


def read(source, call, text):
    return [call.values[one.number] for one in source.expressions if one.text == text]


def test_a_recorded_environment_does_the_same_and_its_code_is_put_back():
    plain, recorded = Cart(), Cart()
    code = Cart.step.__code__
    plain.reset(seed=0)
    with record_expressions(SourceCode(recorded)) as recorder:
        assert Cart.step.__code__ is not code
        recorded.reset(seed=0)
        with recorder.call(1) as noted:
            returned = recorded.step(0.0)
    assert Cart.step.__code__ is code
    assert returned == plain.step(0.0)
    assert noted.events


def test_values_are_noted_by_expression_and_call():
    source, calls = play(Cart())
    assert [len(values) for values in read(source, calls[1], "self.v * H")] == [SUBSTEPS]
    ((place,),) = read(source, calls[1], "super().place() * 1.0")
    assert place == pytest.approx(1.1)
    ((flag,),) = read(source, calls[1], "self.v > 0.5 and self.x >= 0")
    assert flag == 1.0
    ((doubled,),) = read(source, calls[2], "2 * value")
    assert doubled == pytest.approx(2 * (1 + 0.1 + 0.11))


def test_a_value_can_be_forced():
    env = Cart()
    source = SourceCode(env)
    number = next(one.number for one in source.expressions if one.text == "self.v > 0.5")
    with record_expressions(source) as recorder:
        env.reset(seed=0)
        recorder.forced = {number: False}
        assert env.step(0.0)[2] is False


def test_an_array_is_noted_as_it_was():
    source, calls = play(Cart())
    (airs,) = [values for values in read(source, calls[1], "self.air") if values and values[0] is not None]
    assert np.allclose(airs[0], [DT, DT])


def list_times(env):
    source, calls = play(env)
    return {(one.use, one.target): one for one in find_timed_expressions(source, [calls])}


def test_times_and_how_often_they_count():
    found = list_times(Cart())
    assert found[Use.INTEGRATED, "self.x"].total_s == pytest.approx(DT)
    assert found[Use.COUNTED, "self.t"].total_s == pytest.approx(DT)
    assert found[Use.COUNTED, "self.air[leg]"].most == 1  # for each leg
    assert found[Use.DIVIDED, "self.x - self.last"].seconds == pytest.approx(DT)
    times = find_majority(list(found.values()))
    assert (times.control_s, times.substeps) == (pytest.approx(DT), SUBSTEPS)
    assert not any(one.is_wrong(times) for one in found.values())


class CartOfWrongTimes(Cart):
    def step(self, action):
        for _ in range(SUBSTEPS):
            self.x += self.v * DT
        self.t = self.t + H
        speed = abs(self.x - self.last) / H
        self.last = self.x
        return self.x, speed, False, False, {}


def test_wrong_times():
    times = StepTimes(DT, H, "")
    wrong = {use for (use, _), one in list_times(CartOfWrongTimes()).items() if one.is_wrong(times)}
    assert wrong == {Use.INTEGRATED, Use.COUNTED, Use.DIVIDED}


def test_an_environment_of_a_library_has_no_source():
    assert not SourceCode(gymnasium.make("CartPole-v1")).expressions


def test_a_module_that_is_not_a_file_is_left_out(monkeypatch):
    monkeypatch.setitem(sys.modules, "nowhere", SimpleNamespace(__file__=None))
    assert {Path(file).name for file in SourceCode(Cart()).trees} >= {"test_expressions.py"}


def test_imports_of_the_same_package_are_read(tmp_path, monkeypatch):
    files = {
        "beetle/__init__.py": "",
        "beetle/envs/__init__.py": "",
        "beetle/envs/walk.py": "import gymnasium\nimport ladybird\nfrom beetle.rewards.terms import pay\n\n"
        "class Walk(gymnasium.Env):\n    pass\n",
        "beetle/envs/near.py": "",
        "beetle/rewards/__init__.py": "",
        "beetle/rewards/terms.py": "from beetle.rewards import kernels\n\ndef pay():\n    return kernels.near(0)\n",
        "beetle/rewards/kernels.py": "def near(error):\n    return 1 - error\n",
        "beetle/training/__init__.py": "",  # imported by nobody who builds the environment
        "ladybird/__init__.py": "",  # another package
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("beetle.envs.walk", "beetle.envs.near", "beetle.training"):
        importlib.import_module(name)
    source = SourceCode(sys.modules["beetle.envs.walk"].Walk())
    read = {Path(file).relative_to(tmp_path).as_posix() for file in source.trees}
    of_rewards = {"beetle/rewards/kernels.py", "beetle/rewards/terms.py"}
    assert read == {"beetle/envs/__init__.py", "beetle/envs/near.py", "beetle/envs/walk.py", *of_rewards}
    for name in [name for name in sys.modules if name.partition(".")[0] in ("beetle", "ladybird")]:
        del sys.modules[name]


DEEP = """
import gymnasium
from gymnasium import spaces


class Deep(gymnasium.Env):
    observation_space = action_space = spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.observation_space.sample()
        return self.x, {}

    def step(self, action):
        return self.x, float(SUM), False, False, {}

    def move(self, speed, dt=0.1):
        speed = speed / 5
        self.x = self.x + speed / 2 * dt
        return self.x[0]
"""


def test_a_source_that_is_nested_too_deeply_is_not_judged(tmp_path):
    (tmp_path / "deep.py").write_text(DEEP.replace("SUM", " + ".join(["self.x[0]"] * 1500)))
    messages = list(run_here(PROBE, f"{tmp_path}/deep.py:Deep", ["build", "expressions"], 10.0))
    reasons = {message.reason for message in messages if isinstance(message, Skipped)}
    assert reasons == {TOO_DEEP}
    assert [message.crash for message in messages if isinstance(message, Finished)] == ["", ""]


def test_a_name_that_is_assigned_from_itself_is_read(tmp_path):
    (tmp_path / "slow.py").write_text(DEEP.replace("SUM", "self.move(action[0])"))
    messages = list(run_here(PROBE, f"{tmp_path}/slow.py:Deep", ["build", "expressions"], 10.0))
    assert TOO_DEEP not in {message.reason for message in messages if isinstance(message, Skipped)}
