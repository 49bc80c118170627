"""Tasks as Gymnasium environments, for tools that know nothing of rlctl."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest


def test_make_by_id():
    env = gymnasium.make("rlctl.gym:rlctl/reach-v0", tolerance=0.02)
    assert env.unwrapped.task.tolerance == 0.02
    assert env.spec.id == "rlctl/reach-v0"
    observation, _ = env.reset(seed=3)
    assert env.observation_space.contains(observation)
    env.step(env.action_space.sample())
    env.close()


def test_the_time_limit_is_in_the_spec():
    import rlctl

    for env in (rlctl.make("reach"), gymnasium.make("rlctl.gym:rlctl/reach-v0")):
        assert env.spec.max_episode_steps == env.unwrapped.max_steps == 120
        assert env.spec.id == "rlctl/reach-v0"
        env.close()
    again = rlctl.make("reach", tolerance=0.02).spec.make()
    assert again.unwrapped.task.tolerance == 0.02
    again.close()
    assert rlctl.make("Pendulum-v1").spec.max_episode_steps == 200


def test_it_is_the_same_environment():
    import rlctl

    ours, theirs = rlctl.make("reach"), gymnasium.make("rlctl.gym:rlctl/reach-v0")
    np.testing.assert_array_equal(ours.reset(seed=5)[0], theirs.reset(seed=5)[0])
    action = np.full(7, 0.3, np.float32)
    for _ in range(5):
        a, b = ours.step(action), theirs.step(action)
        np.testing.assert_array_equal(a[0], b[0])
        assert a[1:4] == b[1:4]
    ours.close()
    theirs.close()


def test_render_modes_are_passed_on():
    env = gymnasium.make("rlctl.gym:rlctl/reach-v0", render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (240, 320, 3)
    env.close()


def test_a_vector_of_them():
    envs = gymnasium.make_vec("rlctl.gym:rlctl/reach-v0", num_envs=2, vectorization_mode="sync")
    observations, _ = envs.reset(seed=1)
    assert observations.shape == (2, *envs.single_observation_space.shape)
    envs.step(envs.action_space.sample())
    envs.close()


@pytest.mark.slow
def test_registering_imports_no_plugin():
    code = (
        "import sys, rlctl.gym; print(sorted(m for m in sys.modules if m.startswith(('rlctl_', 'pybullet', 'torch'))))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"
