"""Hindsight experience replay: goals are really exchanged, episodes stay whole, and what does not fit is refused."""

import csv
import json
import warnings

import numpy as np
import pytest

from rlctl import load_policy
from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.errors import RecipeError, TaskError
from rlctl.launching.train import run_training
from rlctl.play.workers import Workers
from rlctl.recipe import recipe as recipes
from rlctl.recipe import sources
from rlctl.runs.train_request import TrainRequest
from rlctl.training import checkpoint_file
from rlctl.training.algorithms import build_model
from rlctl.training.learner import begin_next_episodes
from rlctl.training.off_policy import OffPolicyRollouts, replay_arguments
from rlctl.training.progress import Progress
from rlctl.training.rollouts import WorkerVecEnv
from tests.task import tasks
from tests.training.conftest import ENVS, SMALL
from tests.training.envs import Plane

FAST = {"learning_starts": 100, "batch_size": 16}
SMALL_HER = {
    **SMALL,
    "algo": "sac",
    "algo_kwargs": FAST,
    "policy_kwargs": {"net_arch": [16]},
    "her": {},
    "task": {"steps": 10},
}


@pytest.fixture
def build():
    """Build the model of a small recipe on worker environments that are closed at the end."""
    started = []

    def model(env: str, **settings) -> OffPolicyRollouts:
        recipe = sources.fill_defaults(recipes.validate({**SMALL_HER, **settings}, "test"))
        started.append(Workers(recipe.env_specs(env if ":" in env else f"{ENVS}:{env}")[0], recipe.n_envs))
        env = WorkerVecEnv(started[-1], recipe.seed)
        return OffPolicyRollouts(build_model(recipe, env, "cpu"), env, recipe, Progress(next_eval=0))

    yield model
    for workers in started:
        workers.close()


def learn(rollouts: OffPolicyRollouts, steps: int):
    """Play and learn until so many environment steps are done; return the model."""
    rollouts.begin(steps)
    while rollouts.model.num_timesteps < steps:
        rollouts.advance()
    return rollouts.model


@pytest.mark.slow_except("sac-Plane")
@pytest.mark.parametrize(
    ("algo", "env"),
    [("sac", "Plane"), ("td3", "Plane"), ("ddpg", "Plane"), ("tqc", "Plane"), ("xqc", "Plane"), ("dqn", "Corridor")],
)
def test_algorithms_train_in_hindsight(build, algo, env):
    rollouts = build(env, algo=algo)
    before = {name: value.clone() for name, value in rollouts.model.policy.state_dict().items()}
    model = learn(rollouts, 108)
    assert model._n_updates == 2 * 4  # after 104 and 108 steps, one for each of the four
    assert any((value != before[name]).any() for name, value in model.policy.state_dict().items())


def test_goals_are_exchanged_and_rewarded_anew(build):
    """No goal that was wanted is reached within 1e-6: every reward of 0 is of one that was exchanged."""
    model = learn(build("Plane", task={"steps": 10, "tolerance": 1e-6}), 100)
    assert set(model.replay_buffer.rewards[:25].ravel()) == {-1.0}
    batch = model.replay_buffer.sample(400)
    rewards = batch.rewards.numpy().ravel()
    # 1 / (4 + 1) are as they were: 80, and they come first.
    assert set(rewards[:80]) == {-1.0}
    assert 0.0 in rewards[80:]
    assert -1.0 in rewards[80:]
    goals = batch.next_observations["desired_goal"].numpy()
    np.testing.assert_array_equal(batch.observations["desired_goal"].numpy(), goals)
    achieved = batch.next_observations["achieved_goal"].numpy()
    np.testing.assert_array_equal(rewards, Plane(10, 1e-6).compute_reward(achieved, goals, {}))


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize(("goals", "real"), [(1, 100), (3, 50)])
def test_the_final_goal_is_what_an_episode_ended_with(build, goals, real):
    model = learn(build("Plane", her={"n_sampled_goal": goals, "goal_selection_strategy": "final"}), 100)
    batch = model.replay_buffer.sample(200)
    rows = model.replay_buffer.next_observations["achieved_goal"]
    ends = {tuple(each) for each in rows[[9, 19]].reshape(-1, 2).tolist()}  # ten steps an episode
    wanted = {tuple(each) for each in model.replay_buffer.observations["desired_goal"].reshape(-1, 2).tolist()}
    sampled = [tuple(each) for each in batch.observations["desired_goal"].tolist()]
    assert set(sampled[:real]) <= wanted
    assert set(sampled[real:]) <= ends


def test_a_new_stage_leaves_no_episode_behind_that_spans_it(build):
    rollouts = build("Plane", task={"steps": 10})
    model = learn(rollouts, 4 * 13)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # SB3 warns of what is meant here
        begin_next_episodes(model)
    learn(rollouts, 4 * 23)
    buffer = model.replay_buffer
    # 10 steps, 3 that are cut, and 10 of an episode of the next stage; nothing is in the other rows.
    for env in range(4):
        assert buffer.ep_start[:23, env].tolist() == [0] * 10 + [10] * 3 + [13] * 10
        assert buffer.ep_length[:24, env].tolist() == [10] * 10 + [3] * 3 + [10] * 10 + [0]
        # Cut is not over: the value of what would have come counts.
        assert buffer.timeouts[:23, env].tolist() == [0] * 9 + [1, 0, 0, 1] + [0] * 9 + [1]
        assert buffer.dones[:23, env].tolist() == buffer.timeouts[:23, env].tolist()


@pytest.mark.slow
def test_a_curriculum_in_hindsight(train):
    stages = [
        {"task": {"tolerance": 4.0}, "promote": {"success": 1.0, "window": 4, "min_steps": 112}},
        {"task": {"tolerance": 1e-6}},
    ]
    result = train("Plane", {**SMALL_HER, "total_timesteps": 160, "stages": stages})
    assert (result.progress.stage, result.steps) == (2, 160)
    with result.run.metrics_file.open() as file:
        ended = [(row["stage"], row["success"]) for row in csv.DictReader(file) if row["success"]]
    # Everything is near enough in the first stage, and nothing in the second.
    assert set(ended) == {("1", "1.0"), ("2", "0.0")}


def test_an_episode_that_ended_with_its_stage_is_over(build):
    """Without hindsight too: only episodes that go on are cut short."""
    model = learn(build("Ending", her=None, task={}), 4 * 5)
    ended = model.replay_buffer.dones[4].tolist()
    assert set(ended) == {0.0, 1.0}
    begin_next_episodes(model)
    assert model.replay_buffer.dones[4].tolist() == ended
    assert model.replay_buffer.timeouts[4].tolist() == [1.0 - each for each in ended]


def test_learning_starts_by_which_every_first_episode_is_over():
    recipe = sources.fill_defaults(recipes.validate({"algo": "sac", "her": {}, "n_envs": 4}, "test"))
    assert replay_arguments(recipe, recipe.her, goals(max_steps=50))["learning_starts"] == 200
    assert replay_arguments(recipe, recipe.her, goals(max_steps=10))["learning_starts"] == 100  # SB3's own
    assert replay_arguments(recipe, recipe.her, goals(max_steps=None))["learning_starts"] == 100


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "settings", "check", "expected"),
    [
        (
            "Plane",
            {},
            True,
            "goals and a sparse reward; it is learned faster with hindsight: add --algo sac --set her={}",
        ),
        (
            "Plane",
            {},
            False,
            "goals, perhaps with a sparse reward; it is learned faster with hindsight: add --algo sac",
        ),
        ("Plane", {**SMALL_HER, "algo_kwargs": {**FAST, "learning_starts": 1000}}, False, None),
        ("Shaped", {}, True, None),
        ("Line", {}, False, None),
    ],
)
def test_a_training_with_goals_suggests_hindsight(train, small_ppo, capsys, env, settings, check, expected):
    train(env, {**(settings or small_ppo), "total_timesteps": 64, "eval": {"episodes": 1}}, check=check)
    hints = [line for line in capsys.readouterr().err.splitlines() if line.startswith("hint: ")]
    assert len(hints) == (expected is not None)
    assert all(expected in hint for hint in hints)


def goals(max_steps=None) -> EnvInfo:
    env = Plane()
    return EnvInfo(
        observation_space=space_to_json(env.observation_space),
        action_space=space_to_json(env.action_space),
        has_compute_reward=True,
        max_steps=max_steps,
    )


@pytest.mark.slow
def test_a_task_that_computes_rewards(tmp_path):
    settings = {**SMALL_HER, "n_envs": 2, "total_timesteps": 110, "algo_kwargs": {"batch_size": 16}, "task": {}}
    run = run_training(TrainRequest(f"{tasks.__file__}:Place", settings=settings, root=tmp_path, check=False)).run
    found, _ = checkpoint_file.read_newest(run)
    assert found.state.model["counters"]["_n_updates"] == 5 * 2  # after 102, 104, ..., 110 steps
    assert load_policy(run.best_policy).info.env.has_compute_reward


NEEDS = (
    "hindsight needs a Dict observation of observation, achieved_goal, desired_goal, and "
    "compute_reward(achieved_goal, desired_goal, info)"
)


@pytest.mark.parametrize(
    ("env", "settings", "message"),
    [
        (
            "Line",
            {"task": {}},
            "her: this environment has no observation in its observation, no achieved_goal in its observation, "
            f"no desired_goal in its observation, no compute_reward; {NEEDS}",
        ),
        ("NoRewards", {}, f"her: this environment has no compute_reward; {NEEDS}"),
        ("NoWish", {}, f"her: this environment has no desired_goal in its observation; {NEEDS}"),
        (
            "OtherGoal",
            {},
            "her: achieved_goal is Box(-1.0, 1.0, (2,), float32), desired_goal Box(-1.0, 1.0, (3,), float32): "
            "hindsight replaces one by the other, so both must be a Box of the same shape, not an image",
        ),
        (
            "Plane",
            {"algo_kwargs": {**FAST, "n_steps": 3}},
            "algo_kwargs.n_steps: hindsight does not support n-step returns; remove her or n_steps",
        ),
    ],
)
def test_an_environment_that_does_not_fit_is_refused(build, env, settings, message):
    with pytest.raises(RecipeError) as caught:
        build(env, **{"task": {}, **settings})
    assert str(caught.value) == message
    assert caught.value.exit_code == 2


def test_it_is_refused_before_there_is_a_run(train, tmp_path):
    with pytest.raises(RecipeError, match=r"^her: this environment has no observation in its observation, no"):
        train("Line", {**SMALL_HER, "task": {}})
    assert not list(tmp_path.glob("runs/*/*/run.json"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"reward_weights": {"away": -2.0}},
            "her: compute_reward does not use the recipe's reward_weights; remove her or reward_weights",
        ),
        (
            {"stages": [{"promote": {"return": 0.0}, "reward_weights": {"away": -2.0}}, {}]},
            "her: compute_reward does not use the recipe's reward_weights; remove her or reward_weights",
        ),
        (
            {"algo_kwargs": {"buffer_size": 399}},
            "algo_kwargs.buffer_size: 399 steps of 4 environments cannot hold the two complete episodes of "
            "each environment that hindsight needs; 400 is enough",
        ),
    ],
)
def test_recipes_that_do_not_go_together_with_it(settings, message):
    recipe = recipes.validate({"algo": "sac", "her": {}, "n_envs": 4, **settings}, "test")
    with pytest.raises(RecipeError) as caught:
        replay_arguments(sources.fill_defaults(recipe), recipe.her, goals(max_steps=50))
    assert str(caught.value) == message
    assert caught.value.exit_code == 2


def test_learning_waits_for_the_first_whole_episode(build):
    rollouts = build("Plane", algo_kwargs={**FAST, "learning_starts": 16}, task={"steps": 10})
    assert learn(rollouts, 36)._n_updates == 0
    assert learn(rollouts, 44)._n_updates > 0


@pytest.mark.slow
def test_a_buffer_without_room_for_an_episode_ends_a_run(train, tmp_path):
    # 13 rows: the second episode writes over the first from its fourth step on.
    with pytest.raises(RecipeError) as caught:
        train("Plane", {**SMALL_HER, "algo_kwargs": {**FAST, "learning_starts": 44, "buffer_size": 52}})
    assert str(caught.value) == (
        "algo_kwargs.buffer_size: 52 steps of 4 environments cannot hold the two complete episodes of each "
        "environment that hindsight needs; set it to twice the steps of an episode, times 4"
    )
    (status,) = tmp_path.glob("runs/*/*/run.json")
    assert json.loads(status.read_text())["status"] == "failed"


@pytest.mark.slow
def test_a_fault_in_compute_reward_is_named_and_leaves_a_run(train, tmp_path):
    with pytest.raises(TaskError, match=r"compute_reward raised RuntimeError: goals have gone") as caught:
        train("Plane", {**SMALL_HER, "task": {"steps": 10, "fault": "raise"}})
    assert caught.value.exit_code == 3
    (status,) = tmp_path.glob("runs/*/*/run.json")
    assert json.loads(status.read_text())["status"] == "failed"


def test_crossq_has_no_network_for_dictionaries(train):
    with pytest.raises(RecipeError, match=r"^crossq cannot be used here: it has no network for dictionaries$"):
        train("DictObservation", {**SMALL, "algo": "crossq"})
    with pytest.raises(RecipeError, match=r"^crossq cannot be used here: it has no network for images$"):
        train("Image", {**SMALL, "algo": "crossq"})
