"""A task that says what other goals are worth: its environment does too, and any other does not."""

import numpy as np

from rlctl.checking.check import check
from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from tests.task import tasks
from tests.task.tasks import ByName, Place


def test_by_hand(make):
    env = make(Place(tolerance=0.5))
    # 0.5 away is reached, 0.6 is not.
    achieved, desired = np.zeros((3, 2)), np.array([[0.3, 0.4], [0.0, 0.6], [0.0, 0.0]])
    assert env.compute_reward(achieved, desired, [{}] * 3).tolist() == [0.0, -1.0, 0.0]
    assert env.compute_reward(achieved[1], desired[1], {}) == -1.0


def test_it_agrees_with_the_rewards_of_steps(make):
    env = make(Place(tolerance=0.3))
    rewards = set()
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        for _ in range(10):
            towards = 10 * (observation["desired_goal"] - observation["achieved_goal"])
            observation, reward, *_ = env.step(towards)
            assert reward == env.compute_reward(observation["achieved_goal"], observation["desired_goal"], {})
            rewards.add(reward)
    assert rewards == {-1.0, 0.0}


def test_only_tasks_that_define_it_have_it(make):
    assert describe(make(Place())).has_compute_reward
    without = make(ByName())
    assert not hasattr(without, "compute_reward")
    assert not describe(without).has_compute_reward


def test_check_env_finds_nothing_wrong_with_it():
    # One study and its rule: the whole check takes half a minute.
    spec = EnvSpec(f"{tasks.__file__}:Place")
    report = check(spec, rules=["RL614"], only=("hindsight",), env_timeout_s=60.0, show_progress=False)
    assert report.verdict.findings == []
    assert report.verdict.judged == ["RL614"]
