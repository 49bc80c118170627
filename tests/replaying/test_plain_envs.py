from contextlib import closing

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError
from rlctl.play.episode import load_episode, save_episode
from rlctl.replaying.drawable import make_drawable
from rlctl.replaying.recorder import play_episode
from rlctl.replaying.reproduce import verify_episode
from rlctl.replaying.rrd import write_rrd
from tests.replaying.conftest import ENVS, play
from tests.replaying.reading import column, entities, jpegs


def write(rollout, tmp_path):
    path, warnings = tmp_path / "plain.rrd", []
    write_rrd(path, rollout, title="plain", warn=warnings.append)
    assert warnings == []
    return path


def test_actions_rewards_observations_and_pictures(tmp_path):
    rollout, warnings = play("Pixels")
    assert warnings == []
    path = write(rollout, tmp_path)
    steps, actions = column(path, "/action")
    assert steps.tolist() == list(range(1, 11))
    np.testing.assert_array_equal(actions.ravel(), rollout.episode.actions)
    _, rewards = column(path, "/reward/total")
    np.testing.assert_array_equal(rewards, actions)  # its reward is the action
    _, counts = column(path, "/observation/count")
    assert counts.ravel().tolist() == list(range(11))
    pictures = jpegs(path, "/camera")
    assert sorted(pictures) == list(range(11))
    assert pictures[0][:2] == b"\xff\xd8"
    assert sorted(jpegs(path, "/observation/eye")) == list(range(11))


def test_a_dict_inside_a_dict_has_curves_and_is_verified(tmp_path):
    rollout, _ = play("Kitchen")
    # 0.1 per step, from the reset on
    assert column(write(rollout, tmp_path), "/observation/achieved_goal\\/kettle")[1][10].tolist() == [1.0, 1.0, 1.0]
    save_episode(tmp_path / "one.npz", rollout.episode)
    _, verification = verify_episode(load_episode(tmp_path / "one.npz"), tmp_path / "one.npz")
    assert verification.difference is None


def test_an_episode_without_steps_has_a_recording(tmp_path):
    """Of an episode that failed at its reset there are no actions; mended, it is replayed up to there."""
    spec = EnvSpec(f"{ENVS}:Pixels")
    with closing(make_drawable(spec)) as env:
        rollout = play_episode(env, spec, 3, lambda observation, step: None, draw=print)
    assert column(write(rollout, tmp_path), "/observation/count")[0].tolist() == [0]


def test_long_episodes_have_fewer_pictures():
    rollout, _ = play("Pixels", steps=450)
    # More than 100: every second, and again, and again: every eighth step of 450.
    assert [step for step, _ in rollout.scene.pictures] == list(range(0, 451, 8))


def test_time_follows_from_the_frame_rate(tmp_path):
    rollout, _ = play("Pixels")
    assert rollout.dt == 1 / 20


@pytest.mark.parametrize(
    ("name", "parameters", "reason"),
    [
        ("Pixels", {"fault": "render"}, "no camera pictures: render() raised OSError: no OpenGL"),
        ("Blind", {}, "envs.py:Blind takes no render_mode"),
        ("Undrawn", {}, "no camera pictures: render() raised NotImplementedError"),
    ],
)
def test_missing_pictures_cost_a_warning_and_nothing_else_is_missing(name, parameters, reason, tmp_path):
    rollout, warnings = play(name, **parameters)
    assert len(warnings) == 1
    assert reason in warnings[0]
    found = entities(write(rollout, tmp_path))
    assert "/camera" not in found
    assert {"/action", "/reward/total", "/observation/point"} <= found


@pytest.mark.parametrize("task", ["Pendulum-v1", "CartPole-v1"])
def test_gymnasium_environments(task, tmp_path):
    spec = EnvSpec(task)
    with closing(make_drawable(spec)) as env:
        env.action_space.seed(0)
        rollout = play_episode(env, spec, 1, lambda o, k: env.action_space.sample(), policy="", draw=print)
    _, observations = column(write(rollout, tmp_path), "/observation")
    np.testing.assert_array_equal(observations, rollout.episode.observations)


def test_error_of_the_environment_names_seed_and_step():
    with pytest.raises(TaskError) as raised:
        play("Pixels", seed=11, fault="step")
    assert str(raised.value) == (
        f"task '{ENVS}:Pixels': RuntimeError: lost a wheel\n"
        f"in the episode with seed 11, step 4; to see it alone: rlctl check-env {ENVS}:Pixels"
    )
    assert "lost a wheel" in raised.value.details
