"""`place`: a script succeeds, rewards pay each stage more than the last, and where episodes begin."""

import numpy as np
import pytest

from rlctl_manipulation.place import NEAREST, Place, point_down
from tests.manipulation.scripted_hands import CLOSED, OPEN, WORLDS, Script, above

pytest.importorskip("mujoco")

ALL = np.arange(WORLDS)


@pytest.fixture
def script():
    script = Script("rlctl_manipulation.place:Place")
    yield script
    script.worlds.close()


def reset(script, level, seed):
    """Begin episodes of `level` in all worlds."""
    script.worlds.reset(ALL, list(range(WORLDS * seed, WORLDS * seed + WORLDS)), levels=np.full(WORLDS, level))
    return script.task


@pytest.mark.slow
def test_a_script_succeeds_and_each_stage_is_worth_more_than_the_last(script):
    task, paid = script.task, []

    def note(result):
        paid.append(np.median(result.reward))

    note(script.go(above(task.block.base_position, 0.2), OPEN, 20))
    note(script.grasp())
    note(script.go(above(task.block.base_position, 0.1), CLOSED, 20))
    note(script.go(above(task.goal, 0.08), CLOSED, 25))
    note(script.go(task.goal, CLOSED, 20))
    assert not task.is_success().any()  # nothing is released yet
    script.go(task.goal, OPEN, 4)
    note(script.go(above(task.goal, 0.1), OPEN, 15))
    assert task.is_success().sum() >= WORLDS - 1
    assert paid == sorted(paid)
    assert paid[-1] > paid[-2] + 0.8  # letting go is worth more than all that holding at the goal earns


def test_a_block_that_was_never_lifted_is_not_placed(script):
    task = script.task
    script.go(above(task.block.base_position, 0.25), OPEN, 10)
    task.block.set_base(task.goal)
    script.go(above(task.goal, 0.25), OPEN, 12)
    assert not task.is_success().any()
    assert not task.arrived.any()


def test_goals_are_away_from_the_block(script):
    for seed in range(20):
        task = reset(script, 1.0, seed)
        apart = np.linalg.norm(task.goal - task.block.base_position, axis=1)
        assert (apart >= NEAREST).all()
        assert (task.goal >= Place.goal_low).all()
        assert (task.goal <= Place.goal_high).all()
        assert not task.carried.any()


def test_at_low_levels_some_episodes_begin_in_the_hand_at_the_goal(script):
    carried = []
    for seed in range(20):
        task = reset(script, 0.0, seed)
        carried.append(task.carried > 0)
        held = carried[-1]
        np.testing.assert_allclose(task.block.base_position[held], task.goal[held], atol=1e-9)
        np.testing.assert_allclose(task.arm.link_position("grasp")[held], task.goal[held], atol=1e-9)
        script.worlds.step(np.tile([0.0] * 7 + [CLOSED], (WORLDS, 1)).astype(np.float32))
        assert task.grasped[held].all()
    assert 0.3 < np.mean(carried) < 0.7  # 0.5


def test_a_hand_at_a_point_points_down(script):
    task = script.task
    points = np.array([[0.4, -0.2, 0.025], [0.65, 0.2, 0.025], [0.5, 0.0, 0.2], [0.65, -0.2, 0.125]])
    yaw = np.array([0.7, -0.7, 0.0, 0.3])
    task.arm.set_joints(np.column_stack([point_down(points, yaw), np.zeros((WORLDS, 2))]))
    np.testing.assert_allclose(task.arm.link_position("grasp"), points, atol=1e-9)
    np.testing.assert_allclose(task.look(0.0, 0.0, 1.0), np.tile([0.0, 0.0, -1.0], (WORLDS, 1)), atol=1e-9)
    closing = task.look(0.0, 1.0, 0.0)
    np.testing.assert_allclose(closing[:, :2], np.column_stack([np.sin(yaw), -np.cos(yaw)]), atol=1e-6)
