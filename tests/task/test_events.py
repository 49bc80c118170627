"""Events: when they act, what they draw, and that a new episode never feels an old one's."""

import numpy as np
import pytest

from rlctl.errors import RecipeError, TaskError
from rlctl.task import Event, events
from rlctl.task.bullet import pybullet
from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings
from tests.task.tasks import Cart, Slider


@pytest.fixture
def make():
    made = []

    def build(task, randomize=False, **changes):
        made.append(TaskEnv(task, events=EventSettings(randomize, changes)))
        return made[-1]

    yield build
    for env in made:
        env.close()


def mass(env):
    return dynamics(env.task.cube)[0]


def friction(env):
    return dynamics(env.task.plane)[1]


def dynamics(body):
    return pybullet.getDynamicsInfo(body.id, -1, physicsClientId=body.client)


def test_events_rest_unless_asked_for(make):
    env = make(Cart())
    assert env.events == {}
    nominal = mass(env)
    assert env.reset(seed=0)[1] == {}
    assert mass(env) == nominal
    assert "events" not in env.step([0.0])[4]


def test_a_reset_event_draws_from_nominal_every_time(make):
    env = make(Cart(), randomize=True)
    nominal = mass(env)
    drawn = []
    for seed in range(20):
        _, info = env.reset(seed=seed)
        factor = info["events"]["mass"]["factor"]
        assert 0.5 <= factor <= 2.0
        # Not nominal times all the factors so far.
        assert mass(env) == pytest.approx(nominal * factor, rel=1e-6)
        drawn.append(factor)
    assert len(set(drawn)) == 20


def test_inertia_scales_with_the_mass(make):
    env = make(Cart(), mass={"factor": (1.5, 1.5)})
    nominal = dynamics(env.task.cube)[2]
    env.reset(seed=0)
    assert dynamics(env.task.cube)[2] == pytest.approx([1.5 * element for element in nominal])


def test_an_interval_event_acts_at_its_period(make):
    env = make(Cart(), friction={})
    env.reset(seed=0)
    # 0.25 s at 60 Hz: steps 15, 30, 45, 60
    drawn = {step: env.step([0.0])[4].get("events") for step in range(1, 61)}
    acted = [step for step, content in drawn.items() if content]
    assert acted == [15, 30, 45, 60]
    assert friction(env) == pytest.approx(drawn[60]["friction"]["friction"])


def test_what_an_event_changed_ends_with_the_episode(make):
    env = make(Cart(), friction={"every_s": 0.1})
    nominal = friction(env)
    env.reset(seed=0)
    for _ in range(6):
        env.step([0.0])
    assert friction(env) != nominal
    env.reset(seed=1)
    assert friction(env) == nominal


def test_what_build_sets_is_nominal():
    class Heavy(Cart):
        def build(self, sim):
            super().build(sim)
            self.cube.scale_mass(3.0)

    env, plain = TaskEnv(Heavy()), TaskEnv(Cart())
    for _ in range(2):
        env.reset(seed=0)
        assert mass(env) == pytest.approx(3 * mass(plain))
        env.task.cube.scale_mass(2.0)
        assert mass(env) == pytest.approx(6 * mass(plain))
    env.close()
    plain.close()


def test_equal_seeds_draw_equally_whatever_came_before(make):
    env = make(Cart(), randomize=True)

    def episode(seed):
        observations = [env.reset(seed=seed)[0]]
        return np.array([*observations, *(env.step([0.0])[0] for _ in range(60))])

    first = episode(5)
    episode(6)
    np.testing.assert_array_equal(episode(5), first)


def test_a_recipe_changes_parameters(make):
    env = make(Cart(), mass={"factor": [1.25, 1.25]})
    assert list(env.events) == ["mass"]
    assert env.reset(seed=0)[1]["events"] == {"mass": {"factor": 1.25}}
    assert Cart.events["mass"].parameters["factor"] == (0.5, 2.0)


def test_an_event_that_is_part_of_the_problem(make):
    class Pushed(Cart):
        events = {"mass": Event("reset", events.scale_mass, enabled=True, body="cube", factor=(1.0, 1.0))}

    assert make(Pushed()).reset(seed=0)[1] == {"events": {"mass": {"factor": 1.0}}}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mas": {}}, "events: this task has no event 'mas'. Did you mean 'mass'? It has: mass, friction."),
        (
            {"mass": {"factr": (1, 2)}},
            "events.mass: no parameter 'factr'. Did you mean 'factor'? It has: body, factor.",
        ),
    ],
)
def test_a_typo_names_the_closest(changes, message):
    with pytest.raises(RecipeError) as caught:
        TaskEnv(Cart(), events=EventSettings(changes=changes))
    assert str(caught.value) == message


def test_a_task_without_events():
    with pytest.raises(RecipeError, match=r"^events: this task has no event 'mass'. It has: none.$"):
        TaskEnv(Slider(), events=EventSettings(changes={"mass": {}}))


def test_an_event_on_an_unknown_body(make):
    env = make(Cart(), mass={"body": "cub"})
    with pytest.raises(TaskError, match=r"^no body 'cub'\. Did you mean 'cube'\? Loaded: plane, cube\.$"):
        env.reset(seed=0)
