"""The bipeds: what standing and walking are worth, falls, ground, mistakes, episodes that repeat."""

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings
from rlctl.task.model_faults import find_model_faults
from rlctl_locomotion.biped import ANGLE, STANCE, Biped, Biped3D

BIPEDS = {"biped": Biped, "biped-3d": Biped3D}
ALIVE = 0.05
STAND = (STANCE / ANGLE).astype(np.float32)


@pytest.fixture(params=BIPEDS.values(), ids=BIPEDS)
def env(request):
    env = TaskEnv(request.param())
    env.reset(seed=0)
    yield env
    env.close()


@pytest.mark.slow_except("biped")
@pytest.mark.pybullet
def test_it_can_stand(env):
    earned = sum(env.step(STAND)[1] for _ in range(200))
    assert not env.task.is_terminated()
    assert {"left_foot", "right_foot"} == env.task.body.links_touching(env.task.ground)
    # In each of 200 steps; the rest is small, though the free one leans on one foot by 0.06 rad: -2 * 0.06^2 a step
    assert earned == pytest.approx(200 * ALIVE, abs=1.5)
    assert 0.56 < env.task.trunk.position[2] < 0.58  # [m]


def test_standing_earns_less_than_half_of_walking(env):
    """Walking at 0.5 m/s, upright, with a motor power of 60 W and half of each action's range changed in a step."""
    weights = env.reward_weights
    standing = weights["alive"]
    # 0.5 * 1 + 0.5 * 1 + 0.05 - 0.0005 * 60 - 0.2 * 0.5^2 = 0.97
    walking = (
        0.5 * (weights["progress"] + weights["forward_while_alive"])
        + weights["alive"]
        + 60 * weights["energy"]
        + 0.25 * weights["smoothness"]
    )
    assert walking == pytest.approx(0.92 + ALIVE)
    assert standing < 0.5 * walking


def move(task, speed):
    """The whole robot moves forwards [m/s], its joints at rest."""
    if task.body.fixed:
        positions = task.body.joint_positions.copy()
        task.body.set_joints(positions, np.eye(len(positions))[0] * speed)
    else:
        task.body.add_velocity((speed, 0.0, 0.0))


def test_the_terms_of_a_robot_that_moves(env):
    task = env.task
    move(task, 0.5)
    task.update()
    terms = task.rewards(np.zeros(4, np.float32))
    assert terms["progress"] == terms["forward_while_alive"] == pytest.approx(0.5, abs=1e-6)
    assert (terms["alive"], terms["fall"]) == (1.0, 0.0)
    assert terms["posture"] == pytest.approx(0.0, abs=1e-9)
    move(task, 2.5)
    task.update()
    assert task.rewards(np.zeros(4, np.float32))["progress"] == task.top_speed


def test_smoothness_by_hand(env):
    env.step(np.zeros(4))
    info = env.step(np.array([0.5, 0, 0, 0]))[4]
    # 0.5^2 / 4 joints, at -0.2
    assert info["metrics"]["smoothness"] == 0.0625
    assert info["reward_terms"]["smoothness"] == pytest.approx(-0.0125)


def test_it_falls_with_straight_legs(env):
    for _ in range(300):
        _, _, terminated, _, info = env.step(np.zeros(4))
        if terminated:
            break
    assert terminated
    assert env.task.trunk.position[2] < 0.2  # [m]
    assert info["reward_terms"]["fall"] == -15.0
    assert info["reward_terms"]["alive"] == info["reward_terms"]["forward_while_alive"] == 0.0
    assert info["is_success"] is False


def test_success_is_a_distance(env):
    task = env.task
    assert not task.is_success()
    task.trunk = task.trunk._replace(position=(5.0, 0.0, 0.57))
    assert task.is_success()
    task.trunk = task.trunk._replace(position=(5.0, 0.0, 0.19))
    assert not task.is_success()
    task.least_distance = 0.0
    task.trunk = task.trunk._replace(position=(-0.1, 0.0, 0.57))
    assert task.is_success()


def test_the_rail_keeps_a_plane():
    env = TaskEnv(Biped())
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(60):
        _, _, terminated, *_ = env.step(rng.uniform(-1, 1, 4))
        assert abs(env.task.trunk.position[1]) < 1e-6
        assert env.task.trunk.angular_velocity[::2] == pytest.approx((0, 0), abs=1e-6)  # of roll and yaw
        if terminated:
            break
    env.close()


def rows(env, seed, steps=150):
    observations = [env.reset(seed=seed)[0]]
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        observation, reward, terminated, *_ = env.step(STAND + 0.4 * rng.uniform(-1, 1, 4))
        observations.append(np.append(observation, reward)[: len(observations[0])])
        if terminated:
            break
    return np.array(observations)


@pytest.mark.slow
@pytest.mark.parametrize("biped", BIPEDS.values(), ids=BIPEDS)
@pytest.mark.parametrize("roughness", [0.0, 0.04])
def test_episodes_repeat_with_contacts_pushes_and_all_randomisation(biped, roughness):
    def make():
        return TaskEnv(biped(roughness=roughness), events=EventSettings(randomize=True))

    dirty, fresh = make(), make()
    for seed in range(2):
        rows(dirty, 100 + seed)
        np.testing.assert_array_equal(rows(dirty, seed), rows(fresh, seed))
        fresh.close()
        fresh = make()
    dirty.close()
    fresh.close()


def test_what_is_randomised():
    env = TaskEnv(Biped(), events=EventSettings(randomize=True))
    drawn = [env.reset(seed=seed)[1]["events"] for seed in range(50)]
    for event, parameter, low, high in (
        ("mass", "factor", 0.8, 1.2),
        ("friction", "friction", 0.3, 1.5),
        ("gravity", "change", -0.5, 0.5),
    ):
        values = [each[event][parameter] for each in drawn]
        assert low <= min(values) < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < max(values) <= high
    assert {each["action_delay"]["steps"] for each in drawn} == {0, 1}
    env.close()


def test_rough_ground_does_not_end_before_the_episode():
    env = TaskEnv(Biped(roughness=0.03))
    assert env.task.ground.terrain[..., 0].max() > 2 * env.task.top_speed * env.task.episode_s


@pytest.mark.slow
def test_rough_ground_is_walked_on():
    env = TaskEnv(Biped3D(roughness=0.05, terrain_seed=3))
    env.reset(seed=0)
    for _ in range(100):
        env.step(STAND)
    assert {"left_foot", "right_foot"} == env.task.body.links_touching(env.task.ground)
    depth = env.task.body.contacts_with(env.task.ground).distances.min()
    assert depth > -2e-3  # [m]; no foot sinks
    env.close()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"roughness": 0.5}, "roughness: steps of 0.5 m would bury this robot's legs. Use at most 0.1 m."),
        ({"roughness": -0.1}, "terrain: roughness -0.1 m is negative"),
        (
            {"least_distance": 30.0},
            "least_distance: 30 m is out of reach: at top_speed 1 m/s an episode of 20 s is 20 m long.",
        ),
    ],
)
def test_mistakes(parameters, message):
    with pytest.raises(TaskError) as caught:
        TaskEnv(Biped(**parameters))
    assert str(caught.value) == message


@pytest.mark.pybullet
def test_nothing_is_wrong_with_the_models(env):
    assert find_model_faults(env.task.body) == []
    masses = 4.0 + 2 * (0.8 + 0.5 + 0.2)  # [kg]
    body = env.task.body
    from rlctl.task.pybullet.library import pybullet

    weights = [
        pybullet.getDynamicsInfo(body.id, index, physicsClientId=body.client)[0]
        for index in range(-1, len(body.link_names))
    ]
    assert sum(weights) == pytest.approx(masses, abs=0.03)
