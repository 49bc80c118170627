"""Mistakes in events, of a recipe and of a task: found when the environment is built, with the closest name."""

import pytest

from rlctl.errors import RecipeError, TaskError
from rlctl.task import Event, events
from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings, Range
from tests.task.tasks import Cart, Slider
from tests.task.test_changes import Arm


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mas": {}}, "events: this task has no event 'mas'. Did you mean 'mass'? It has: mass, friction."),
        (
            {"mass": {"factr": (1, 2)}},
            "events.mass: no parameter 'factr'. Did you mean 'factor'? It has: body, factor, links.",
        ),
    ],
)
def test_a_typo_names_the_closest(changes, message):
    with pytest.raises(RecipeError) as caught:
        TaskEnv(Cart(), events=EventSettings(changes=changes))
    assert str(caught.value) == message


def test_a_typo_in_the_event_of_a_task():
    event = Event("interval", events.push, body="cart", force=1.0, every=0.5)
    with pytest.raises(
        TaskError, match=r"^events\.push: no parameter 'every'\. Did you mean 'every_s'\? It has: body, "
    ):
        event.bind("push")


def test_a_task_without_events():
    with pytest.raises(RecipeError, match=r"^events: this task has no event 'mass'. It has: none.$"):
        TaskEnv(Slider(), events=EventSettings(changes={"mass": {}}))


RANGE = "Write [low, high], a number, or {from: [low, high], to: [low, high]}."


@pytest.mark.pybullet
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"mass": {"factor": [1.2, 0.8]}},
            "events.mass.factor: [1.2, 0.8] is reversed. Write the lower value first: [0.8, 1.2].",
        ),
        ({"mass": {"factor": [-0.5, 1.0]}}, "events.mass.factor: -0.5 is not above 0."),
        ({"mass": {"factor": 0}}, "events.mass.factor: 0 is not above 0."),
        ({"friction": {"friction": [-0.1, 1.0]}}, "events.friction.friction: -0.1 is not at least 0."),
        ({"color": {"red": [0.0, 255]}}, "events.color.red: 255 is not at most 1."),
        ({"mass": {"factor": "big"}}, f"events.mass.factor: 'big' is not a range of finite numbers. {RANGE}"),
        ({"mass": {"factor": [1, 2, 3]}}, f"events.mass.factor: [1, 2, 3] is not a range of finite numbers. {RANGE}"),
        ({"mass": {"factor": [1, True]}}, f"events.mass.factor: [1, True] is not a range of finite numbers. {RANGE}"),
        (
            {"mass": {"factor": [0.5, float("inf")]}},
            f"events.mass.factor: [0.5, inf] is not a range of finite numbers. {RANGE}",
        ),
        (
            {"mass": {"factor": {"form": 1, "to": 2}}},
            f"events.mass.factor: a range has the keys 'from' and 'to', not 'form', 'to'. {RANGE}",
        ),
        ({"mass": {"factor": {"from": 1, "to": [-1, 2]}}}, "events.mass.factor.to: -1 is not above 0."),
        ({"push": {"every_s": 0}}, "events.push.every_s: 0 is not above 0."),
        ({"push": {"every_s": "often"}}, f"events.push.every_s: 'often' is not a range of finite numbers. {RANGE}"),
        (
            {"mass": {"every_s": 1}},
            "events.mass: no parameter 'every_s'. It has: body, factor, links.",
        ),
        ({"mass": {"body": 3}}, "events.mass.body: expected text, got 3"),
        ({"mass": {"body": "amr"}}, "events.mass: no body 'amr'. Did you mean 'arm'? Loaded: plane, arm, cube."),
        (
            {"mass": {"body": "cube"}},
            "events.mass: cube_small.urdf has no link 'lbr_iiwa_link_7'. It has: only its base, 'baseLink'.",
        ),
        (
            {"push": {"link": "handle"}},
            "events.push: cube_small.urdf has no link 'handle'. It has: only its base, 'baseLink'.",
        ),
        (
            {"damping": {"joints": ["joint_1"]}},
            "events.damping: kuka_iiwa.urdf has no joint 'joint_1'. Did you mean 'lbr_iiwa_joint_1'? It has: "
            + ", ".join(f"lbr_iiwa_joint_{i}" for i in range(1, 8))
            + ".",
        ),
        (
            {"damping": {"body": "plane"}},
            "events.damping: plane.urdf has no joints",
        ),
        (
            {"kick": {"body": "arm"}},
            "events.kick: body 'arm' is fixed to the world: a kick cannot move it",
        ),
    ],
)
def test_what_a_recipe_gets_wrong_is_found_when_the_environment_is_built(changes, message):
    with pytest.raises(RecipeError) as caught:
        TaskEnv(Arm(), events=EventSettings(changes=changes))
    assert str(caught.value) == message


def untyped(sim, rng, *, size):
    return {}


def forgets_its_draw(sim, rng, *, size: Range):
    rng.uniform(*size)


@pytest.mark.pybullet
@pytest.mark.parametrize(
    ("event", "message"),
    [
        (Event("reset", events.scale_mass, factor=1.0), "events.e: parameter 'body' is missing. It has: body, fac"),
        (Event("reset", events.scale_mass, body="cube", factor=(2, 1)), "events.e.factor: [2, 1] is reversed. "),
        (
            Event("reset", events.push, body="cube", force=1.0),
            "events.e: push does not act at 'reset', but at: start, i",
        ),
        (
            Event("reset", events.noise, std=1.0),
            "events.e: noise does not act at 'reset', but at: observation, action.",
        ),
        (
            Event("rest", events.scale_mass),
            "events.e: no moment 'rest'. Did you mean 'reset'? There are: reset, start, ",
        ),
        (
            Event("reset", forgets_its_draw, enabled=True, size=(0, 1)),
            "events.e: its function must return a dict of the drawn numbers by name, not None",
        ),
        (
            Event("reset", untyped, size=(0, 1)),
            "events.e: 'size' of untyped has no type, so it cannot be checked. Write `size: Range` for "
            "a range of random values, else its type.",
        ),
        (Event("reset", events.scale_mass, body="cub", factor=1.0, enabled=True), "events.e: no body 'cub'. Did you"),
    ],
)
def test_what_a_task_gets_wrong_is_found_when_the_environment_is_built(event, message):
    class Wrong(Arm):
        events = {"e": event}

    with pytest.raises(TaskError) as caught:
        TaskEnv(Wrong())
    assert str(caught.value).startswith(message)
