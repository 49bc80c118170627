"""A class that is no whole task is named as what it is."""

from dataclasses import dataclass

import numpy as np
import pytest

from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError
from rlctl.task import Box, Task
from rlctl.task.env import TaskEnv
from rlctl.task.events import scale_mass
from rlctl.task.joints import Joints


class Whole(Task):
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    reward_weights = {"one": 1.0}

    def build(self, sim):
        pass

    def act(self, action):
        pass

    def observe(self):
        return {"zero": np.zeros(1)}

    def rewards(self, action):
        return {"one": 1.0}


class ForgottenDataclass(Whole):
    tolerance: float = 0.1
    hint: int  # no value, so no parameter that was meant


@dataclass
class Parameters(Whole):
    tolerance: float = 0.1


class ForgottenBelow(Parameters):
    height: float = 0.3


class SpaceFromParameters(Whole):
    def __init__(self):
        self.action_space = Box(-1.0, 1.0, (2,), np.float32)


def missing(*names: str) -> type[Task]:
    """Return a task without some of its attributes."""
    content = {name: value for name, value in vars(Whole).items() if name not in (*names, "__dict__", "__weakref__")}
    return type("MyArm", (Task,), content)


@pytest.mark.parametrize(
    ("cls", "message"),
    [
        (missing("build"), "MyArm does not define build(); a task needs build, act, observe, rewards"),
        (
            missing("act", "rewards"),
            "MyArm does not define act(), rewards(); a task needs build, act, observe, rewards",
        ),
        (
            type("Standing", (Whole,), {"control_dt": 0.0}),
            "Standing: control_dt is 0.0; it must be a time above 0 [s]",
        ),
        (
            type("Endless", (Whole,), {"episode_s": float("inf")}),
            "Endless: episode_s is inf; it must be a time above 0 [s]",
        ),
        (
            type("Timeless", (Whole,), {"substeps": 0}),
            "Timeless: substeps is 0; it must be a whole number, at least 1",
        ),
        (
            type("Rate", (Whole,), {"control_dt": 50}),
            "Rate: control_dt is 50 s, longer than an episode of 5.0 s",
        ),
        (
            type("Half", (Whole,), {"substeps": 4.5}),
            "Half: substeps is 4.5; it must be a whole number, at least 1",
        ),
        (
            type("Layout", (Whole,), {"observation_layout": "Dict"}),
            "Layout: observation_layout is 'Dict'; it must be 'flat' or 'dict'",
        ),
        (
            type("Bounds", (Whole,), {"observation_bounds": {"zero": 3.0}}),
            "Bounds: observation_bounds of 'zero' are 3.0; they must be two numbers, (low, high)",
        ),
        (
            type("Swapped", (Whole,), {"observation_bounds": {"zero": (1, -1)}}),
            "Swapped: observation_bounds of 'zero' are (1, -1); they must be two numbers, (low, high)",
        ),
        (
            type("Bare", (Whole,), {"events": {"mass": scale_mass}}),
            "Bare: events.mass is not an Event: Event('reset', scale_mass, body=...), for example",
        ),
        (
            type("Tuple", (Whole,), {"action_space": (-1, 1, 3)}),
            "Tuple does not define action_space: Box(-1.0, 1.0, (7,), np.float32), for example",
        ),
        (type("Named", (Whole,), {"robot": 3}), "Named: robot of the class is 3; it must be text"),
        (
            type("Units", (Whole,), {"observation_units": {"zero": 1.0}}),
            "Units: observation_units has 'zero': 1.0; both must be text",
        ),
        (
            type("Numbered", (Whole,), {"describe_joints": lambda self: Joints([1])}),
            "joints: names must be text, not 1",
        ),
        (
            type("Flat", (Whole,), {"observe": lambda self: np.zeros(2)}),
            "Flat: observe() returned array([0., 0.]), not a dict of values by name: {'speed': ...}",
        ),
        (
            type("Blind", (Whole,), {"observe": lambda self: {}}),
            "Blind: observe() returned {}, not a dict of values by name: {'speed': ...}",
        ),
        (
            type("Names", (Whole,), {"describe_joints": lambda self: ["hip"]}),
            "Names: describe_joints() returned ['hip']; return body.describe_joints(names) with 1 names, "
            "one per element of the action",
        ),
        (
            type("Few", (Whole,), {"describe_joints": lambda self: Joints(["hip", "knee"])}),
            "Few: describe_joints() returned ['hip', 'knee']; return body.describe_joints(names) with 1 names, "
            "one per element of the action",
        ),
        (
            missing("action_space"),
            "MyArm does not define action_space: Box(-1.0, 1.0, (7,), np.float32), for example",
        ),
        (
            ForgottenDataclass,
            "ForgottenDataclass has parameters (tolerance) but is not a dataclass: "
            "write @dataclass in the line above the class",
        ),
        (
            ForgottenBelow,
            "ForgottenBelow has parameters (height) but is not a dataclass: "
            "write @dataclass in the line above the class",
        ),
    ],
)
def test_what_is_missing_is_named(cls, message):
    with pytest.raises(TaskError) as raised:
        TaskEnv(cls())
    assert str(raised.value) == message


@pytest.mark.parametrize("cls", [Whole, Parameters, SpaceFromParameters])
def test_whole_tasks_are_built(cls):
    TaskEnv(cls()).close()


class NamesItsBody(Whole):
    """The most natural name of the body is also the attribute for the robot's name."""

    robot = "cube on a plane"

    def build(self, sim):
        self.robot = sim.load("cube", "cube_small.urdf", position=(0, 0, 1))

    def observe(self):
        return {"height": self.robot.base_position[2:]}


@pytest.mark.pybullet
def test_a_body_may_be_called_robot():
    env = TaskEnv(NamesItsBody())
    assert env.reset(seed=0)[0].tolist() == [1.0]
    assert describe(env).robot == "cube on a plane"
    env.close()


def test_the_name_of_the_robot_is_not_annotated():
    with pytest.raises(TaskError, match=r"^Annotated\.robot is annotated, which would make it a parameter"):
        type("Annotated", (Task,), {"__annotations__": {"robot": str}, "robot": "arm"})


def test_an_attribute_of_an_instance_that_cannot_be_described():
    env = TaskEnv(Whole())
    env.task.action_meaning = 3
    with pytest.raises(TaskError, match=r"^Whole\.action_meaning: expected text, got 3$"):
        describe(env)
    env.close()


def test_a_parameter_of_a_class_that_forgot_it(write_module, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_module("arm.py", "from rlctl.task import Task\n\n\nclass Arm(Task):\n    tolerance: float = 0.1\n")
    with pytest.raises(TaskError, match=r"^Arm has parameters \(tolerance\) but is not a dataclass"):
        EnvSpec("arm.py:Arm", {"tolerance": 0.2}).make()


@pytest.mark.parametrize(
    ("method", "value", "message"),
    [
        ("rewards", {"one": np.zeros(2)}, "Odd: reward term 'one' is array([0., 0.]) at step 1, not a number"),
        ("rewards", {"one": None}, "Odd: reward term 'one' is None at step 1, not a number"),
        ("is_success", np.array([True, False]), "Odd: is_success() returned array([ True, False]), not True or False"),
        ("is_success", 0.37, "Odd: is_success() returned 0.37, not True or False"),
    ],
)
def test_a_value_of_a_wrong_type_is_named(method, value, message):
    env = TaskEnv(type("Odd", (Whole,), {method: lambda self, *action: value})())
    env.reset(seed=0)
    with pytest.raises(TaskError) as raised:
        env.step(np.zeros(1))
    env.close()
    assert str(raised.value) == message
