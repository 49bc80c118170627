"""The gear arm: closed loop and gears under random torques, goals in reach, a scripted grasp, episodes that repeat."""

import math

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings
from rlctl.task.model_faults import find_model_faults
from rlctl_manipulation.gear_arm import (
    ELBOW,
    GEAR,
    HOME,
    OPEN,
    STOPS,
    TORQUE,
    GearArm,
    find_joints_for,
    stop_torque,
)


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


def steer(task, point, fingers=0.0):
    """Return the action of a controller that holds the tool at a point: a spring and a damper at each joint."""
    error = find_joints_for(point) - task.arm.joint_positions[task.joints]
    torque = 60 * error - 1.0 * task.arm.joint_velocities[task.joints]  # [N m]
    torque[1:] -= (2.5, 0.8)  # [N m], about what the arm's weight does
    return np.clip([*(GEAR * torque / TORQUE), fingers], -1, 1).astype(np.float32)


@pytest.fixture
def env():
    env = TaskEnv(GearArm())
    env.reset(seed=0)
    yield env
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize(("held_for", "steps"), [slow(1, 3000), (10, 1000), slow(10, 3000), slow(50, 3000)])
def test_the_linkage_and_the_gears_hold(env, held_for, steps):
    """20 or 60 s of random torques, new ones every `held_for` control steps: 1 mm, 0.5 degrees."""
    task, rng = env.task, np.random.default_rng(held_for)
    gap = parallelogram = gears = fingers = 0.0
    reached = []
    names = task.arm.joint_names
    for step in range(steps):
        if step % held_for == 0:
            action = rng.uniform(-1, 1, 4).astype(np.float32)
        task.act(action)
        env.sim.step()
        task.update()
        angles = dict(zip(names, task.arm.joint_positions, strict=True))
        gap = max(gap, task.linkage.gap)
        parallelogram = max(parallelogram, abs(angles["elbow"] + angles["shoulder"] - angles["crank"]))
        errors = [angles[name] - GEAR * angles[f"{name}_motor"] for name in ("turn", "shoulder", "crank")]
        gears = max(gears, *np.abs([*errors, angles["wrist"] + angles["crank"]]))
        fingers = max(fingers, abs(angles["left_finger_joint"] - angles["right_finger_joint"]))
        reached.append(task.tool)
    assert gap < 1e-3  # [m]
    assert math.degrees(parallelogram) < 0.5
    assert math.degrees(gears) < 0.5
    assert fingers < 1e-3  # [m]
    assert np.ptp(reached, axis=0).min() > 0.1  # [m]; it did move


def test_the_linkage_drives_the_forearm(env):
    task = env.task
    for shoulder, crank in ((-0.4, 1.57), (0.2, 1.4)):
        task.arm.set_joints(task.pose(np.array([0.3, shoulder, crank]), 0.01))
        assert task.linkage.gap < 1e-6
        # Two links of 0.3 m, sloping by the shoulder's angle and by the crank's, and a tool that hangs down.
        r = 0.3 * math.cos(shoulder) + 0.3 * math.cos(crank)
        z = 0.5 - 0.3 * math.sin(shoulder) - 0.3 * math.sin(crank) - 0.1
        wanted = (r * math.cos(0.3), r * math.sin(0.3), z)
        assert task.arm.link_position("tool") == pytest.approx(wanted, abs=1e-6)


def test_goals_are_in_reach(env):
    for x in (-0.3, 0.0, 0.3):
        for y in (-0.3, 0.0, 0.3):
            turn, shoulder, crank = find_joints_for((x, y, 0.1))
            assert STOPS["shoulder"][0] < shoulder < STOPS["shoulder"][1]
            assert STOPS["crank"][0] < crank < STOPS["crank"][1]
            assert ELBOW[0] < crank - shoulder < ELBOW[1]
            task = env.task
            task.arm.set_joints(task.pose(np.array([turn, shoulder, crank]), 0.01))
            assert task.arm.link_position("tool") == pytest.approx((x, y, 0.1), abs=1e-6)


@pytest.mark.slow_except("1")
@pytest.mark.parametrize("seed", range(3))
def test_a_goal_can_be_reached_and_held(env, seed):
    env.reset(seed=seed)
    for _ in range(200):
        *_, info = env.step(steer(env.task, env.task.goal))
    assert info["is_success"]
    assert info["metrics"]["distance"] < 0.05


def grasp_and_lift(env, seed):
    """Go above the object, down, close, up; returns observations and rewards, and the last info."""
    rows = [np.append(env.reset(seed=seed)[0], 0.0)]
    task = env.task
    start = task.goal.copy()
    for step in range(450):
        above = 0.08 if step < 100 else max(0.0, 0.08 - 0.001 * (step - 100))
        closing = 1.0 if step < 200 else -1.0
        if step >= 260:
            above = min(0.12, 0.001 * (step - 260))
        observation, reward, _, _, info = env.step(steer(task, start + np.array([0, 0, above]), closing))
        rows.append(np.append(observation, reward))
    return np.array(rows), info


@pytest.mark.parametrize("stage", [slow("grasp"), slow("lift")])
def test_an_object_can_be_grasped_and_lifted(stage):
    env = TaskEnv(GearArm(stage=stage))
    lifted = []
    for seed in range(3):  # two of three
        if sum(lifted) == 2:
            break
        _, info = grasp_and_lift(env, seed)
        lifted.append(info["is_success"])
        if info["is_success"]:
            # All of the grasp, less what the object is off the middle; it hangs 5 cm or more above the table.
            assert info["metrics"]["grasp"] > 0.8
            assert info["metrics"]["lift"] == 1.0
    assert sum(lifted) >= 2, lifted
    env.close()


@pytest.mark.slow
def test_closed_fingers_on_top_of_an_object_do_not_hold_it():
    env = TaskEnv(GearArm(stage="grasp"))
    env.reset(seed=0)
    task = env.task
    above = task.goal + np.array([0.0, 0.0, 0.06])
    for step in range(240):
        down = min(0.04, 0.0005 * max(0, step - 120))  # [m], to where the tips would be in the object
        _, _, _, _, info = env.step(steer(task, above - np.array([0.0, 0.0, down]), -1.0))
    assert task.arm.links_touching(task.cube) >= {"left_finger", "right_finger"}
    assert info["metrics"]["grasp"] < 0.5
    assert info["is_success"] is False
    env.close()


def test_the_way_to_an_object_goes_over_it(env):
    task = env.task
    task.object = task.tool + np.array([0.06, 0.08, 0.0])
    # 0.1 m beside it: 0.06 m above it is the next place to go to
    assert task.measure_way() == pytest.approx(math.hypot(0.1, 0.06))
    task.object = task.tool + np.array([0.0, 0.02, -0.03])
    # 0.02 m beside it: 2 * 0.01 m above it, so 0.01 m further down
    assert task.measure_way() == pytest.approx(math.hypot(0.02, 0.01))
    task.object = task.tool + np.array([2.0, 0.0, -0.6])
    assert task.measure_way() == 0.5


def test_an_object_off_the_table_is_lost():
    env = TaskEnv(GearArm(stage="lift"))
    env.reset(seed=0)
    for _ in range(10):
        _, reward, terminated, _, info = env.step(np.zeros(4, np.float32))
        assert (info["metrics"]["lost"], terminated) == (0, False)
    env.task.cube.set_base((0.8, 0.0, 0.1))
    while not terminated:
        _, reward, terminated, _, info = env.step(np.zeros(4, np.float32))
    assert info["metrics"]["lost"] == 1
    assert reward < -50
    assert info["is_success"] is False
    env.close()


def test_a_head_start():
    """Half way on average: the tool is anywhere between its home and the place over the object."""
    env = TaskEnv(GearArm(stage="lift", head_start=0.5))
    ways = []
    for seed in range(30):
        env.reset(seed=seed)
        task = env.task
        over = find_joints_for(task.goal + np.array([0.0, 0.0, 0.035]))
        ways.append((task.arm.joint_positions[task.joints] - HOME)[0] / (over - HOME)[0])
        assert task.linkage.gap < 1e-3
    assert 0.3 < np.mean(ways) < 0.7
    assert np.min(ways) < 0.25 < 0.75 < np.max(ways)
    env.close()
    env = TaskEnv(GearArm(stage="lift", head_start=100.0))
    for seed in range(10):
        env.reset(seed=seed)
        x, y, z = env.task.tool - env.task.goal
        assert math.hypot(x, y) < 0.01
        assert 0 < z < 0.075
        env.step(np.array([0, 0, 0, 1], np.float32))
        assert np.linalg.norm((env.task.cube.base_position - env.task.goal)[:2]) < 0.002  # untouched
    env.close()


def test_a_grasp_by_hand():
    env = TaskEnv(GearArm(stage="grasp", head_start=100.0))
    env.reset(seed=0)
    task = env.task
    fingers = [task.left_finger, task.left_finger + 1]

    def measure(above, opening, held=False):
        task.object = task.tool - np.array([0.0, 0.0, above])
        task.arm.set_joints(task.pose(find_joints_for(task.tool), opening))
        return task.measure_grasp(task.measure_way(), held)

    assert task.arm.joint_positions[fingers].min() > 0.6 * OPEN
    assert measure(0.04, OPEN) == pytest.approx(0.5 * math.exp(-4))  # twice the scale of 2 cm
    assert measure(0.04, 0.0) == 0  # closed, the fingers would stand on it
    assert measure(0.0, OPEN) == pytest.approx(0.5)
    assert measure(0.0, 0.027) == pytest.approx(0.5 + 0.25 * 0.5)  # half closed, to a cube of 4 cm
    assert measure(0.0, 0.02, held=True) == pytest.approx(1.0)
    env.close()


def test_the_terms_by_hand(env):
    task = env.task
    task.goal = task.arm.link_position("tool") + np.array([0.03, 0.0, 0.04])
    task.update()
    terms = task.rewards(np.array([1.0, 0.0, -1.0, 0.0], np.float32))
    assert terms["distance"] == pytest.approx(0.05)
    assert terms["arrival"] == pytest.approx(math.exp(-1))
    assert terms["amplitude"] == 0.5  # two of four
    assert terms["time"] == 0.02  # [s]
    assert terms["grasp"] == pytest.approx(0.5 * math.exp(-1))


def test_energy_is_torque_times_speed(env):
    # Motors at 5 N m, less what the end stops do: none near home.
    env.step(np.array([1.0, 0, 0, 0]))
    task = env.task
    speed = abs(task.arm.joint_velocities[task.motors][0])
    assert task.rewards(np.zeros(4, np.float32))["energy"] == pytest.approx(5 * speed, rel=1e-6)
    assert speed > 0.1


def test_end_stops():
    # 60 N m/rad
    assert stop_torque(1.0, 0.5, 2.9) == 0
    assert stop_torque(0.4, 0.5, 2.9) == pytest.approx(6.0)
    assert stop_torque(3.0, 0.5, 2.9) == pytest.approx(-6.0)


@pytest.mark.slow
@pytest.mark.parametrize(("stage", "randomize"), [("reach", True), slow("lift", False), slow("lift", True)])
def test_episodes_repeat_bit_for_bit(stage, randomize):
    def make():
        return TaskEnv(GearArm(stage=stage), events=EventSettings(randomize))

    dirty, fresh = make(), make()
    grasp_and_lift(dirty, 100)
    np.testing.assert_array_equal(grasp_and_lift(dirty, 0)[0], grasp_and_lift(fresh, 0)[0])
    fresh.close()
    dirty.close()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"goal_range": 0.5}, "goal_range: goals up to 0.5 m to each side are out of reach. The arm gets to 0.33 m."),
        ({"stage": "push"}, "stage: 'push' is not one of: reach, grasp, lift"),
    ],
)
def test_mistakes(parameters, message):
    with pytest.raises(TaskError) as caught:
        TaskEnv(GearArm(**parameters))
    assert str(caught.value) == message


def test_nothing_is_wrong_with_the_models(env):
    assert [fault for body in env.sim.bodies.values() for fault in find_model_faults(body)] == []
    assert env.task.arm.joint_positions[env.task.joints] == pytest.approx(HOME, abs=0.1)
