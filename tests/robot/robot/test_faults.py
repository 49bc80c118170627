"""How faults are written, and joints that do not move."""

import numpy as np
import pytest

from rlctl.engine import MUJOCO
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl_robot.robot.commands import CommandQueue
from rlctl_robot.robot.faults import Faults, parse_faults, set_stuck_joints


def test_faults_that_act_together():
    text = "delay=0.02, jitter=0.01,drop=0.1,frozen=speed,frozen=height,nan=force,stuck=knee"
    assert parse_faults(text) == Faults(text, 0.02, 0.01, 0.1, ("speed", "height"), ("force",), ("knee",))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("dely=1", r"^--fault dely=1: 'dely=1' is not a fault\. Did you mean 'delay'\? Known: delay=, jitter=, drop="),
        ("stuck", r"^--fault stuck: 'stuck' is not a fault"),
        ("delay=soon", r"^--fault delay=soon: delay is 'soon'; give a time from 0 to 60 \[s\]$"),
        ("jitter=nan", r"^--fault jitter=nan: jitter is 'nan'; give a time"),
        ("drop=10", r"^--fault drop=10: drop is '10'; give a share from 0 to 1$"),
    ],
)
def test_what_is_no_fault(text, problem):
    with pytest.raises(UsageError, match=problem):
        parse_faults(text)


def test_an_older_command_does_not_replace_a_newer_one():
    queue, (first, second) = CommandQueue(), np.eye(2)
    queue.put(0.25, 1, first)
    queue.put(0.15, 2, second)
    assert queue.take(0.1) is None
    assert queue.take(0.2) is second
    assert queue.take(0.3) is None  # the first arrives now


def test_a_stuck_joint():
    env = EnvSpec("reach", sim=MUJOCO).make()

    def measure_motion():
        observation, _ = env.reset(seed=3)
        start = observation[:7].copy()
        for _ in range(10):
            observation, *_ = env.step(np.ones(7, np.float32))
        return np.abs(observation[:7] - start)

    set_stuck_joints(env, EnvSpec("reach"), ("lbr_iiwa_joint_3",))
    motion = measure_motion()
    assert motion[2] < 1e-3
    assert motion[[0, 1, 3, 4, 5, 6]].min() > 0.05
    set_stuck_joints(env, EnvSpec("reach"), ())
    assert measure_motion()[2] > 0.05
    with pytest.raises(UsageError, match=r"^--fault stuck: no joint 'lbr_iiwa_joint_9'\. Did you mean 'lbr_iiwa"):
        set_stuck_joints(env, EnvSpec("reach"), ("lbr_iiwa_joint_9",))
    env.close()
