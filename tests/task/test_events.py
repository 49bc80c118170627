"""Events: when they act, what they draw, how they widen, and that a new episode never feels an old one's."""

import numpy as np
import pytest

from rlctl.task import Event, events
from rlctl.task.env import TaskEnv
from rlctl.task.events import Range
from rlctl.task.pybullet.library import pybullet
from tests.task.tasks import Cart

pytestmark = pytest.mark.pybullet


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


def test_an_episode_starts_the_same_with_and_without_events(make):
    nominal, randomized = make(Cart()), make(Cart(), randomize=True)
    for seed in range(5):
        observations = [env.reset(seed=seed)[0].tolist() for env in (nominal, randomized)]
        assert observations[0] == observations[1]


def test_a_change_to_one_event_leaves_the_draws_of_the_others(make):
    drawn = []
    for changes in ({}, {"mass": {"factor": (0.9, 1.1)}}):
        env = make(Cart(), randomize=True, **changes)
        mass = env.reset(seed=7)[1]["events"]["mass"]
        frictions = [env.step([0.0])[4].get("events") for _ in range(60)]
        drawn.append((mass, frictions))
    assert drawn[0][0] != drawn[1][0]
    assert drawn[0][1] == drawn[1][1] != [None] * 60


def test_a_reset_without_a_seed_goes_on_with_the_streams(make):
    one, other = make(Cart(), randomize=True), make(Cart(), randomize=True)
    for env in (one, other):
        env.reset(seed=1)
    again = [env.reset()[1]["events"]["mass"] for env in (one, other)]
    assert again[0] == again[1] != one.reset(seed=1)[1]["events"]["mass"]


def test_a_recipe_changes_parameters(make):
    env = make(Cart(), mass={"factor": [1.25, 1.25]})
    assert list(env.events) == ["mass"]
    assert env.reset(seed=0)[1]["events"] == {"mass": {"factor": 1.25}}
    assert Cart.events["mass"].parameters["factor"] == (0.5, 2.0)


def test_an_event_that_is_part_of_the_problem(make):
    class Pushed(Cart):
        events = {"mass": Event("reset", events.scale_mass, enabled=True, body="cube", factor=(1.0, 1.0))}

    assert make(Pushed()).reset(seed=0)[1] == {"events": {"mass": {"factor": 1.0}}}


@pytest.mark.slow
def test_ranges_widen_with_the_level(make):
    env = make(Cart(), mass={"factor": {"from": [0.9, 1.1], "to": [0.5, 2.1]}})

    def drawn_at(level):
        env.set_level(level)
        return np.array([env.reset(seed=seed)[1]["events"]["mass"]["factor"] for seed in range(200)])

    assert env.worlds.level == 1.0  # without a curriculum everything is as wide as it gets
    # Half way: 0.7 to 1.6
    for level, low, high in [(0.0, 0.9, 1.1), (0.5, 0.7, 1.6), (1.0, 0.5, 2.1)]:
        drawn = drawn_at(level)
        assert low <= drawn.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < drawn.max() <= high
    # The same chance at every level: from one seed, the same place in the range.
    np.testing.assert_allclose((drawn_at(0.0) - 0.9) / 0.2, (drawn_at(1.0) - 0.5) / 1.6)


def test_a_level_holds_for_whole_episodes(make):
    env = make(Cart(), friction={"every_s": 1 / 60, "friction": {"from": 0.5, "to": 1.5}})
    env.set_level(0.0)
    env.reset(seed=0)
    env.set_level(1.0)
    assert env.step([0.0])[4]["events"]["friction"]["friction"] == 0.5
    env.reset(seed=0)
    assert env.step([0.0])[4]["events"]["friction"]["friction"] == 1.5


def test_an_event_of_the_authors_own(make):
    def tilt(sim, rng, *, angle: Range):
        drawn = float(rng.uniform(*angle))
        sim.body("cube").set_base((0, 0, 1), (np.sin(drawn / 2), 0, 0, np.cos(drawn / 2)))
        return {"angle": drawn}

    class Tilted(Cart):
        events = {"tilt": Event("start", tilt, angle={"from": (0.0, 0.0), "to": (0.3, 0.5)})}

    env = make(Tilted(), randomize=True)
    drawn = env.reset(seed=0)[1]["events"]["tilt"]["angle"]
    assert 0.3 <= drawn <= 0.5
    assert env.task.cube.base_orientation[0] == pytest.approx(np.sin(drawn / 2))
    env.set_level(0.0)
    assert env.reset(seed=0)[1]["events"] == {"tilt": {"angle": 0.0}}
