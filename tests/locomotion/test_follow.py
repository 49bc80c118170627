"""The bows: clips from keyframes, tasks that follow them, and controllers with the clip inside."""

import contextlib

import numpy as np
import pytest

from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.task.motion import read_motion
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.tasks.motion_faults import find_faults, measure_heights
from rlctl_locomotion import make_clips
from rlctl_locomotion.follow import HumanoidBow, QuadrupedBow

TASKS = {
    "humanoid-bow": ("rlctl_locomotion.follow:HumanoidBow", HumanoidBow, make_clips.make_humanoid_bow),
    "quadruped-bow": ("rlctl_locomotion.follow:QuadrupedBow", QuadrupedBow, make_clips.make_quadruped_bow),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_clips_are_those_of_the_keyframes(name):
    _, cls, make = TASKS[name]
    built, stored = make(), read_motion(make_clips.CLIPS / f"{name}.csv")
    assert (stored.rate, list(stored.joint_names)) == (50.0, cls.joint_order)
    assert stored.joint_positions == pytest.approx(built.joint_positions, abs=1e-5)
    assert stored.root_position == pytest.approx(built.root_position, abs=1e-5)
    body = MujocoSim(control_dt=0.02, substeps=1).load("robot", cls.model)
    assert find_faults(body, stored, measure_heights(body, stored)) == []


def test_keyframes_are_at_rest_and_joined_smoothly():
    rows = make_clips.blend([(0.0, 1.0), (1.0, 3.0), (2.0, 3.0)])
    assert len(rows) == 101
    assert rows[[0, 25, 50, 100], 0] == pytest.approx([1.0, 2.0, 3.0, 3.0])
    assert np.abs(np.diff(rows[:, 0]))[[0, 49]] == pytest.approx([0.0, 0.0], abs=1e-3)


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize("name", TASKS)
def test_starts_are_in_the_clip(name):
    target, cls, _ = TASKS[name]
    with contextlib.closing(EnvSpec(target, parameters={"start_noise": 0.0}, randomize=True).make()) as env:
        env.reset(seed=3)
        task = env.unwrapped.task
        now = cls.reference.compare(task.body, task.rows)
        assert task.rows[0] > 0
        assert now.joints == pytest.approx([0.0], abs=1e-6)
        assert now.velocity == pytest.approx([0.0], abs=1e-6)
        # The mirror image of all that it observes and does is declared, and the table is that of the clip.
        info = describe(env)
        assert set(cls.mirror) >= {*info.observation_sizes, "action"}
        wanted = cls.reference.joint_positions[cls.reference.following[task.rows[0]]]
        assert info.observation_terms["joints"](task.rows * 0.02) == pytest.approx(wanted, abs=1e-6)
    with contextlib.closing(EnvSpec(target).as_deployed().make()) as env:
        env.reset(seed=3)
        assert env.unwrapped.task.rows.tolist() == [0]


def test_further_worlds_of_a_process_change_no_velocity_of_the_clip():
    velocities = []
    for _ in range(2):
        with contextlib.closing(EnvSpec(TASKS["humanoid-bow"][0]).make()):
            velocities.append(HumanoidBow.reference.velocity.copy())
    assert (velocities[0] == velocities[1]).all()


@pytest.mark.slow
def test_zero_actions_are_not_enough():
    with contextlib.closing(EnvSpec(TASKS["quadruped-bow"][0]).as_deployed().make()) as env:
        env.reset(seed=0)
        truncated = terminated = False
        while not (truncated or terminated):
            *_, terminated, truncated, info = env.step(np.zeros(12, np.float32))
        assert truncated  # it plays the clip to its end,
        assert not info["is_success"]  # but its springs give way
