"""The five classics on their own: resets that forget everything, rewards by hand, recipes, check-env."""

import numpy as np
import pytest

from rlctl.engine import MUJOCO
from rlctl.recipe import sources
from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings
from rlctl.task.pybullet.library import pybullet
from rlctl_locomotion.robots import Ant, HalfCheetah, Hopper, Humanoid, Walker2D

pytestmark = pytest.mark.pybullet

ROBOTS = {"ant": Ant, "half-cheetah": HalfCheetah, "hopper": Hopper, "walker2d": Walker2D, "humanoid": Humanoid}


def live(env, seed, actions):
    """Observations and rewards of an episode, shape (T + 1, ...), and how many contacts were seen."""
    rows, contacts = [np.append(env.reset(seed=seed)[0], 0.0)], 0
    for action in actions:
        observation, reward, terminated, *_ = env.step(action)
        rows.append(np.append(observation, reward))
        contacts += len(pybullet.getContactPoints(physicsClientId=env.sim.client))
        if terminated:
            break
    return np.array(rows), contacts


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_an_episode_after_others_is_as_in_a_fresh_world(robot):
    class Endless(robot):  # most would fall and end in a second
        def is_terminated(self):
            return False

    dirty = TaskEnv(Endless())
    actions = np.random.default_rng(0).uniform(-1, 1, (150, *dirty.action_space.shape)).astype(np.float32)
    for seed in range(2):
        _, contacts = live(dirty, 1000 + seed, actions[::-1][: 60 + 60 * seed])
        assert contacts > 20
        fresh = TaskEnv(Endless())
        after_others, contacts = live(dirty, seed, actions)
        assert contacts > 50
        np.testing.assert_array_equal(after_others, live(fresh, seed, actions)[0], err_msg=f"seed {seed}")
        fresh.close()
    dirty.close()


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_joints_start_within_a_tenth_of_a_radian(robot):
    env = TaskEnv(robot())
    starts = []
    for seed in range(100):
        env.reset(seed=seed)
        starts.append(env.task.body.joint_positions[env.task.joints])
    low, high = np.min(starts), np.max(starts)
    assert -0.1 <= low < -0.098
    assert 0.098 < high <= 0.1
    env.close()


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_damping_acts_on_the_motors_joints_alone(robot):
    env = TaskEnv(robot(), events=EventSettings(changes={"joint_damping": {"damping": [0.3, 0.3]}}))
    env.reset(seed=0)
    body = env.task.body
    pybullet.syncBodyInfo(physicsClientId=env.sim.client)
    infos = [pybullet.getJointInfo(body.id, index, physicsClientId=env.sim.client) for index in body.joint_indices]
    damping = {info[1].decode(): info[6] for info in infos}
    assert damping == {name: 0.3 if name in robot.motors else 0.0 for name in body.joint_names}
    env.close()


def test_the_terms_of_a_falling_ant():
    env = TaskEnv(Ant())
    env.reset(seed=0)
    _, reward, terminated, _, info = env.step(np.zeros(8))
    # In the air and up: 1. No torque. All four ankles start near 0, below or above what their limits allow: -0.1 each.
    terms = info["reward_terms"]
    assert (terms["alive"], terms["electricity"], terms["joints_at_limit"]) == (1.0, 0.0, pytest.approx(-0.4))
    assert terms["progress"] == pytest.approx(0.0, abs=0.1)  # [m/s]
    assert reward == pytest.approx(0.6 + terms["progress"])
    assert not terminated
    env.close()


@pytest.mark.parametrize(("robot", "weight"), [(Hopper, 1.0), (Humanoid, 4.25)])
def test_electricity_by_hand(robot, weight):
    env = TaskEnv(robot())
    env.reset(seed=0)
    task, motors = env.task, env.action_space.shape[0]
    velocities = np.zeros(len(task.body.joint_names))
    velocities[task.joints][:2] = 2.0, -4.0  # [rad/s]
    task.body.set_joints(np.zeros(len(velocities)), velocities)
    action = np.zeros(motors, np.float32)
    action[:2] = 1.0, 0.5
    task.last_potential = 0.0
    # 2 * (1 * 0.2 + 0.5 * 0.4) + 0.1 * (1 + 0.25) = 0.8 + 0.125, a mean over all motors
    assert task.rewards(action)["electricity"] == pytest.approx(weight * 0.925 / motors)
    env.close()


def test_a_push_forwards_is_progress_in_metres_per_second():
    env = TaskEnv(Ant())
    env.reset(seed=0)
    env.task.body.add_velocity((2.0, 0.0, 0.0))
    progress = [env.step(np.zeros(8))[4]["metrics"]["progress"] for _ in range(2)]
    # The floor stays, the torso moves, and 20 links are read a substep late: 2 m/s * (1 + 20 * 3 / 4) / 22 = 1.45 m/s.
    assert progress[0] == pytest.approx(1.45, rel=0.01)
    # Then all 21 move by a whole step: 2 * 21 / 22 = 1.91, less 1.7 % of PyBullet's damping.
    assert progress[1] == pytest.approx(1.91, rel=0.025)
    env.close()


def test_contacts_are_observed_one_step_late():
    env = TaskEnv(Hopper())
    env.reset(seed=0)
    touched = [False]
    for _ in range(15):
        observation, *_ = env.step(np.zeros(3))
        assert bool(observation[-1]) == touched[-1]
        touched.append("foot" in env.task.body.links_touching(env.task.floor))
    assert True in touched[:-1]
    env.close()


def test_the_half_cheetah_goes_on_when_it_does_not_stand():
    env = TaskEnv(HalfCheetah())
    env.reset(seed=0)
    task = env.task
    assert task.alive() == 1.0
    task.last_feet_contact = np.array([0, 0, 0, 0, 1, 0], np.float32)  # bshin
    assert task.alive() == -1.0
    assert not task.is_terminated()
    task.last_feet_contact = np.array([1, 0, 0, 1, 0, 0], np.float32)  # both feet
    assert task.alive() == 1.0
    env.close()


def test_motors_in_another_order_than_the_model():
    class Mixed(Hopper):
        motors = {"leg_joint": 1.0, "thigh_joint": 1.0, "foot_joint": 1.0}

    with pytest.raises(ValueError, match=r"^hopper.xml: name the motors one after the other, as the model has them$"):
        TaskEnv(Mixed())


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_randomized_episodes_repeat_too(robot):
    class Endless(robot):
        def is_terminated(self):
            return False

    def make():
        return TaskEnv(Endless(), events=EventSettings(randomize=True))

    dirty = make()
    actions = np.random.default_rng(0).uniform(-1, 1, (250, *dirty.action_space.shape)).astype(np.float32)
    live(dirty, 1000, actions[:200])  # to between the first push and the second
    fresh = make()
    np.testing.assert_array_equal(live(dirty, 1, actions)[0], live(fresh, 1, actions)[0])
    fresh.close()
    _, info = dirty.reset(seed=0)
    drawn = info["events"]
    floor, torso = dirty.task.floor, dirty.task.body
    assert 0.8 <= drawn["mass"]["factor"] <= 1.2
    assert drawn["friction"]["friction"] == dynamics(floor)[1]
    assert drawn["motor_strength"]["factor"] == pytest.approx(torso.motor_strength[0])
    heard = [dirty.step(action)[4].get("events", {}) for action in actions]
    # Every 3 s: after 182 steps of 16.5 ms.
    assert [step for step, events in enumerate(heard, start=1) if "push" in events] == [182]
    dirty.close()


def dynamics(body):
    return pybullet.getDynamicsInfo(body.id, -1, physicsClientId=body.client)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_packaged_recipe(name):
    assert sources.resolve(name, None, {}).algo == "tqc"


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_nothing_is_found_by_check_env(rlctl, name):
    done = rlctl("check-env", name)
    assert done.returncode == 0, done.stdout
    assert f"{name}: no findings" in done.stdout


def test_the_time_limit_is_a_parameter():
    env = TaskEnv(Ant(episode_s=0.033))
    env.reset(seed=0)
    ends = [env.step(np.zeros(env.action_space.shape, np.float32))[2:4] for _ in range(2)]
    assert ends == [(False, False), (False, True)]
    assert Ant().max_steps == 1000


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_an_episode_in_mujoco_stays_finite(robot):
    class Endless(robot):
        def is_terminated(self):
            return False

    pytest.importorskip("mujoco")
    env, rng = TaskEnv(Endless(), sim=MUJOCO), np.random.default_rng(0)
    observation, bullet = env.reset(seed=0)[0], TaskEnv(robot())
    # The same joints and start. The height is of the torso's centre of mass, which the engines place differently.
    np.testing.assert_allclose(observation[1:], bullet.reset(seed=0)[0][1:], atol=1e-4)
    for _ in range(env.max_steps):
        observation, reward, *_ = env.step(rng.uniform(-1, 1, env.action_space.shape))
        assert np.isfinite(observation).all()
        assert np.isfinite(reward)
    bullet.close()
    env.close()
