"""Reach with a sparse reward: goals by name, rewards of other goals, the recipe, export and replay."""

import json

import numpy as np
import pytest
from gymnasium import spaces

from rlctl.errors import TaskError
from rlctl.recipe import sources
from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings
from rlctl_manipulation.reach import HOME
from rlctl_manipulation.reach_sparse import ReachSparse


@pytest.fixture
def env():
    env = TaskEnv(ReachSparse())
    yield env
    env.close()


def test_the_observation(env):
    assert isinstance(env.observation_space, spaces.Dict)
    assert {name: space.shape for name, space in env.observation_space.items()} == {
        "observation": (14,),
        "achieved_goal": (3,),
        "desired_goal": (3,),
    }
    observation, _ = env.reset(seed=0)
    hand, goal = env.task.arm.link_position("lbr_iiwa_link_7"), env.task.goal
    np.testing.assert_array_equal(observation["achieved_goal"], hand.astype(np.float32))
    np.testing.assert_array_equal(observation["desired_goal"], goal.astype(np.float32))


@pytest.mark.parametrize(
    ("away", "reward", "strict", "success"),
    [(0.051, -1.0, 0.0, False), (0.049, 0.0, 0.0, True), (0.021, 0.0, 0.0, True), (0.019, 0.0, 1.0, True)],
)
def test_the_reward(env, away, reward, strict, success):
    env.reset(seed=0)
    task = env.task
    task.goal = task.arm.link_position("lbr_iiwa_link_7") + np.array([0.0, away, 0.0])
    terms = task.rewards(np.zeros(7, np.float32))
    assert env.reward_weights["away"] * terms["away"] == reward
    assert terms["within_2_cm"] == strict
    assert env.reward_weights["within_2_cm"] == 0.0  # a measure
    assert task.is_success() is success


def test_rewards_of_other_goals(env):
    achieved = np.array([[0.5, 0.0, 0.3], [0.5, 0.0, 0.3], [0.6, 0.1, 0.4]])
    desired = np.array([[0.5, 0.04, 0.3], [0.5, 0.06, 0.3], [0.6, 0.1, 0.4]])
    assert env.compute_reward(achieved, desired, {}).tolist() == [0.0, -1.0, 0.0]
    assert env.compute_reward(achieved[1], desired[1], {}) == -1.0
    env.reset(seed=0)
    for _ in range(5):
        observation, reward, *_ = env.step(np.ones(7))
        assert env.compute_reward(observation["achieved_goal"], observation["desired_goal"], {}) == reward


def test_all_events_act():
    env = TaskEnv(ReachSparse(), events=EventSettings(randomize=True))
    _, info = env.reset(seed=0)
    assert set(info["events"]) == set(ReachSparse.events)
    assert {"mass", "gravity", "color", "state_noise", "goal_noise", "action_delay"} <= set(ReachSparse.events)
    env.close()


def test_the_recipe():
    packaged = sources.resolve("reach-sparse", None, {})
    assert packaged.algo == "sac"
    assert packaged.her is not None


@pytest.mark.slow
def test_train_eval_export_replay(rlctl, tmp_path):
    small = ["--set", "algo_kwargs.learning_starts=500", "--set", "eval.episodes=2", "--set", "eval.every_steps=1000"]
    done = rlctl("train", "reach-sparse", "-n", "1000", "-o", str(tmp_path), *small)
    assert done.returncode == 0, done.stderr
    [run] = (tmp_path / "reach-sparse").glob("*_s0")
    done = rlctl("eval", str(run), "--episodes", "2", "--json", "-")
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["episodes"]) == 2
    assert rlctl("export", str(run), "--onnx").returncode == 0
    assert rlctl("replay", str(run), "--episodes", "1").returncode == 0


def test_goals_are_drawn_from_the_box():
    env = TaskEnv(ReachSparse(goal_low=(0.5, -0.1, 0.3), goal_high=(0.5, 0.1, 0.4), start_noise=0.0))
    goals = np.array([env.reset(seed=seed)[0]["desired_goal"] for seed in range(40)])
    assert (goals[:, 0] == 0.5).all()
    assert -0.1 <= goals[:, 1].min() < -0.08
    assert 0.39 < goals[:, 2].max() <= 0.4
    assert (env.task.arm.joint_positions == HOME).all()
    env.close()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (
            {"goal_high": (0.9, 0.3, 0.6)},
            "goal_low, goal_high: a corner of the box is 0.98 m from the shoulder, and the arm gets to 0.88 m. "
            "Use a smaller box.",
        ),
        (
            {"goal_low": (0.45, 0.4, 0.2)},
            "goal_low [0.45, 0.4, 0.2], goal_high [0.7, 0.3, 0.6]: give low <= high, above the floor",
        ),
    ],
)
def test_goals_that_cannot_be(parameters, message):
    with pytest.raises(TaskError) as caught:
        TaskEnv(ReachSparse(**parameters))
    assert str(caught.value) == message
