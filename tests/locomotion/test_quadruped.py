"""The quadruped: its stance, what walking is worth, commanded speeds, mistakes, episodes that repeat."""

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings
from rlctl.task.model_faults import find_model_faults
from rlctl_locomotion.quadruped import FEET, Quadruped


@pytest.fixture
def env():
    env = TaskEnv(Quadruped())
    env.reset(seed=0)
    yield env
    env.close()


@pytest.mark.pybullet
def test_it_stands_in_its_stance(env):
    for _ in range(100):
        _, _, terminated, _, info = env.step(np.zeros(12))
    assert not terminated
    assert env.task.trunk.position[2] == pytest.approx(0.27, abs=0.01)  # [m]
    assert env.task.body.links_touching(env.task.ground) == set(FEET)
    assert env.task.body.contacts_with(env.task.ground).distances.min() > -1e-3  # [m]; no foot sinks
    assert info["metrics"]["alive"] == 1.0
    # 12.5 kg or so, on four feet
    weight = env.task.body.contacts_with(env.task.ground).forces.sum() / 9.81
    assert weight == pytest.approx(12.454, rel=0.02)


def test_standing_earns_less_than_half_of_walking(env):
    task, weights = env.task, env.reward_weights
    task.command = 0.5

    def earned(speed):
        task.body.set_base((0.0, 0.0, 0.27))
        task.body.add_velocity((speed, 0.0, 0.0))
        task.update()
        terms = task.rewards(np.full(12, 0.5, np.float32) * (speed > 0))
        return sum(weights[name] * value for name, value in terms.items())

    # exp(-(0.5 / 0.25)^2) + 0.2 = 0.2183
    assert earned(0.0) == pytest.approx(0.2183, abs=1e-3)
    # 1 + 0.5 * 0.5 + 0.2 - 0.12 * 0.25 = 1.42
    assert earned(0.5) == pytest.approx(1.42, abs=1e-3)
    # Faster is not better: exp(-(0.5 / 0.25)^2) + 0.5 * 0.5 + 0.2 - 0.03 = 0.438
    assert earned(1.0) == pytest.approx(0.4383, abs=1e-3)


def test_the_commanded_speed_is_observed():
    env = TaskEnv(Quadruped(slowest=0.2, fastest=0.4))
    commands = []
    for seed in range(50):
        observation, _ = env.reset(seed=seed)
        commands.append(env.task.command)
        assert observation[-13] == np.float32(env.task.command)  # before the last action
    assert 0.2 <= min(commands) < 0.22
    assert 0.38 < max(commands) <= 0.4
    env.close()


def test_a_collapse_ends_the_episode(env):
    env.task.body.set_base((0, 0, 0.145))
    env.task.body.set_joints(np.array([0.0, 1.4, -2.6] * 4))
    env.task.update()
    assert env.task.is_terminated()
    assert env.task.rewards(np.zeros(12, np.float32))["alive"] == 0.0
    assert env.task.rewards(np.zeros(12, np.float32))["fall"] == 1.0


def test_success_is_a_mean_speed(env):
    task = env.task
    task.command, task.steps = 0.5, 100  # 2 s
    for walked, good in ((0.79, False), (0.81, True), (1.19, True), (1.21, False)):
        task.trunk = task.trunk._replace(position=(walked, 0.0, 0.27))
        assert task.is_success() is good


def rows(env, seed, steps=120):
    observations = [env.reset(seed=seed)[0]]
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        observation, reward, terminated, *_ = env.step(0.7 * rng.uniform(-1, 1, 12))
        observations.append(np.append(observation, reward)[-len(observation) :])
        if terminated:
            break
    return np.array(observations)


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [pytest.param(0.0, marks=pytest.mark.slow), 0.04])
def test_episodes_repeat_with_contacts_pushes_and_all_randomisation(roughness):
    def make():
        return TaskEnv(Quadruped(roughness=roughness), events=EventSettings(randomize=True))

    dirty = make()
    for seed in range(2):
        rows(dirty, 100 + seed)
        fresh = make()
        np.testing.assert_array_equal(rows(dirty, seed), rows(fresh, seed))
        fresh.close()
    dirty.close()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"roughness": 0.2}, "roughness: steps of 0.2 m would bury this robot's legs. Use at most 0.08 m."),
        ({"slowest": 0.8}, "slowest 0.8, fastest 0.7 m/s: give 0 <= slowest <= fastest"),
    ],
)
def test_mistakes(parameters, message):
    with pytest.raises(TaskError) as caught:
        TaskEnv(Quadruped(**parameters))
    assert str(caught.value) == message


def test_nothing_is_wrong_with_the_model(env):
    assert find_model_faults(env.task.body) == []
