"""examples/press: what the sensors of a pressing arm say, and that its episodes repeat."""

import numpy as np
import pytest

from rlctl.environments import registry
from rlctl.task.env import TaskEnv

pytestmark = pytest.mark.pybullet


@pytest.fixture
def env(request):
    task = registry.load(f"{request.config.rootpath}/examples/press/press.py:Press")
    env = TaskEnv(task())
    yield env
    env.close()


def press(env, seed):
    """Press with 20 N: down while the table pushes back with less, up while it does with more."""
    rows, pushed = [env.reset(seed=seed)[0]], 0.0
    for _ in range(env.max_steps):
        observation, _, _, _, info = env.step(np.array([np.clip((20 - pushed) / 20, -1, 1) / 2]))
        rows.append(observation)
        pushed = float(env.task.pad.contacts_with(env.task.table).forces.sum())
    return rows, pushed, info


def test_what_the_sensors_say(env):
    rows, pushed, info = press(env, 0)
    assert pushed == pytest.approx(20.0, abs=0.2)
    # The wrist carries that, less the weight of the last link and the pad: 20 - (0.3 + 0.1) kg * 9.81 m/s^2 = 16.08 N
    assert rows[-1]["wrist_force"][2] == pytest.approx(16.08, abs=0.3)
    assert info["metrics"]["excess_force"] == 0.0
    assert info["metrics"]["penetration"] < 1e-3  # [m]
    assert info["is_success"]


@pytest.mark.slow
def test_a_camera_of_ten_pictures_a_second(env):
    rows, _, _ = press(env, 0)
    pictures = [row["camera"] for row in rows]
    assert pictures[0].shape == (48, 64, 3)
    assert pictures[0].dtype == np.uint8
    changes = [step for step in range(1, 60) if (pictures[step] != pictures[step - 1]).any()]
    assert changes
    assert all(step % 6 == 0 for step in changes)  # of 60 control steps a second


@pytest.mark.slow
def test_pressing_repeats_bit_for_bit(env):
    first, _, _ = press(env, 1)
    press(env, 2)
    again, _, _ = press(env, 1)
    for one, other in zip(first, again, strict=True):
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])
