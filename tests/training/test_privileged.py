"""A critic that sees more than the actor: what it sees, what the actor does not, and what is refused."""

from pathlib import Path

import numpy as np
import onnx
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import RecipeError, TaskError, UsageError
from rlctl.exporting.export import export_policy
from rlctl.exporting.export_request import ExportRequest
from rlctl.play.messages import Play
from rlctl.play.shared_arrays import CRITIC
from rlctl.play.workers import Workers
from rlctl.policy.file import PolicyFile
from rlctl.policy.load import load_policy
from rlctl.recipe.recipe import merge
from rlctl.task.privileged import CriticSight
from tests.training.comparing import assert_same_run

pytest.importorskip("mujoco")

NETS = Path(__file__).with_name("own_nets.py")
STOOL = "tests.task.batches:Stool"
SEEN = {"task": True, "events": True}
SMALL = {
    "n_envs": 4,
    "total_timesteps": 128,
    "eval": {"episodes": 2, "every_steps": 128},
    "algo_kwargs": {"n_steps": 16, "batch_size": 32, "n_epochs": 2},
    "randomize": True,
    "privileged": {},
}


def test_values_have_their_places():
    shown = CriticSight("Task", {"velocity": np.zeros(2)}, {"mass": {"factor": 1.0}, "push": {"x": 0.0, "y": 0.0}})
    assert shown.sizes == {"velocity": 2, "events/mass": 1, "events/push": 2}
    row = np.zeros(5, np.float32)
    shown.write_task(row, {"velocity": np.array([3.0, 4.0])})
    shown.write_events(row, {"push": {"y": 6.0, "x": 5.0}})  # the mass is not drawn yet
    assert row.tolist() == [3.0, 4.0, 0.0, 5.0, 6.0]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"speed": np.zeros(2)}, "privileged\\(\\) returned \\['speed'\\], at first \\['velocity'\\]"),
        ({"velocity": np.zeros(3)}, "privileged\\(\\)\\['velocity'\\] has 3 elements, at first it had 2"),
    ],
)
def test_what_a_task_names_must_stay_the_same(parts, message):
    with pytest.raises(TaskError, match=message):
        CriticSight("Task", {"velocity": np.zeros(2)}, {}).write_task(np.zeros(2, np.float32), parts)


def test_one_world_and_many_show_the_same():
    spec = EnvSpec(STOOL, randomize=True)
    env = spec.make()
    env.unwrapped.worlds.show_critic(**SEEN)
    batch = spec.make_worlds(3)
    batch.show_critic(**SEEN)
    seeds, some = [5, 6, 7], np.array([0, 2])
    batch.reset(np.arange(3), seeds)
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 2)).astype(np.float32)
    for action in actions:
        batch.step(np.stack([action, action]), some)
    rows = batch.observe_privileged(some)
    for row, seed in zip(rows, (5, 7), strict=True):
        env.reset(seed=seed)
        for action in actions:
            env.step(action)
        np.testing.assert_array_equal(row, env.unwrapped.worlds.observe_privileged(np.zeros(1, int))[0])
    shown = env.unwrapped.worlds.critic
    assert list(shown.sizes)[:2] == ["goal", "place"]
    assert shown.sizes["events/kick"] == 2  # drawn at an interval
    assert shown.sizes["events/late"] == 1  # drawn with the first observation
    assert (rows != 0).any(axis=0)[: shown.size - 1].all()


def test_final_values_belong_to_the_episode_that_ended():
    with Workers(EnvSpec(STOOL), 2, n_workers=1, privileged={"task": True, "events": False}) as workers:
        workers.set_other_policy("random")
        workers.start_playing(Play(40, dict.fromkeys(range(2), 3), next_episodes={0: 1, 1: 1}))
        ended = workers.finish_playing()
        segment = workers.arrays.segment
        for episode in ended:
            goal, next_goal = segment.final[CRITIC][episode.env, episode.row, 0], segment.observation[CRITIC]
            assert goal == next_goal[episode.env, episode.row, 0] != next_goal[episode.env, episode.row + 1, 0]
    assert ended


@pytest.mark.slow  # the exact resume of such a training is a quick test
def test_the_number_of_workers_changes_nothing(train, use_cores):
    with use_cores(1):
        one = train(STOOL, SMALL, envs="").run
    with use_cores():
        assert_same_run(one, train(STOOL, SMALL, envs="").run)


@pytest.mark.slow
def test_only_the_actor_is_exported(train, tmp_path):
    run = train(STOOL, SMALL, envs="").run
    policy = PolicyFile.read(run.last_policy)
    sizes = sum(policy.info.privileged.values())
    observed = policy.info.env.spaces()[0].shape[0]
    assert sizes > 4
    assert policy.tensors["policy/mlp_extractor.policy_net.0.weight"].shape[1] == observed
    assert policy.tensors["policy/mlp_extractor.value_net.0.weight"].shape[1] == observed + sizes
    assert policy.tensors["normalize//mean"].shape == (observed,)
    actor = policy.actor_only()
    assert not any("value" in name or name.startswith("critic") for name in actor.tensors)
    action = load_policy(run.last_policy).predict(np.zeros(observed, np.float32))
    actor.write(tmp_path / "shipped.safetensors")
    np.testing.assert_array_equal(load_policy(tmp_path / "shipped.safetensors").predict(np.zeros(observed)), action)
    (report,) = export_policy(ExportRequest(str(run.path), ("onnx",), "last", None))
    ports = onnx.load(str(report.path)).graph.input
    assert [[axis.dim_value for axis in port.type.tensor_type.shape.dim][1:] for port in ports] == [[observed]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algo", "own"),
    [
        ("ppo", {}),
        ("ppo", {"share_features_extractor": False}),
        ("sac", {}),
        ("recurrent_ppo", {"lstm_hidden_size": 8}),
    ],
)
def test_networks_of_ones_own(train, algo, own):
    kwargs = {"features_extractor_class": f"{NETS}:Gated", "features_extractor_kwargs": {"features_dim": 6}, **own}
    of_algorithm = {"algo_kwargs": {"learning_starts": 16, "batch_size": 16}} if algo == "sac" else {}
    run = train(STOOL, {**SMALL, "algo": algo, "policy_kwargs": kwargs, **of_algorithm}, envs="").run
    (report,) = export_policy(ExportRequest(str(run.path), ("onnx",), "last", None))
    assert report.not_verified == ""
    again = train(
        STOOL, {**SMALL, "algo": algo, "policy_kwargs": kwargs, **of_algorithm}, envs="", initial_policy=str(run.path)
    )
    assert again.run.path != run.path


@pytest.mark.slow
def test_a_policy_with_a_privileged_critic_starts_another_training(train, tmp_path):
    run = train(STOOL, SMALL, envs="").run
    source = PolicyFile.read(run.last_policy)
    again = train(STOOL, merge(SMALL, {"total_timesteps": 64}), envs="", initial_policy=str(run.last_policy)).run
    assert PolicyFile.read(again.last_policy).info.privileged == source.info.privileged
    with pytest.raises(UsageError, match=r"its critic saw goal, place, .* the recipe's sees nothing else"):
        train(STOOL, merge(SMALL, {"privileged": None}), envs="", initial_policy=str(run.last_policy))
    source.actor_only().write(shipped := tmp_path / "shipped.safetensors")
    later = train(STOOL, merge(SMALL, {"total_timesteps": 64}), envs="", initial_policy=str(shipped)).run
    # The critic's own statistics start again: of two rollouts of 64 steps they have those steps only.
    assert PolicyFile.read(later.last_policy).tensors["critic/var"].max() > 0


@pytest.mark.slow_except(first=3)
@pytest.mark.parametrize(
    ("settings", "task", "message"),
    [
        ({"algo": "td3"}, STOOL, "td3 has no critic that may see more than its actor; ppo, a2c, rec"),
        ({}, "Line", "is a plain Gymnasium environment; only tasks have it"),
        ({}, "reach", "a critic of Reach would see no more than the actor"),
        ({"privileged": {"event": True}}, STOOL, "no key 'privileged.event'. Did you mean 'events'?"),
        ({"mirror": True}, STOOL, "mirror: tests.task.batches:Stool declares no mirror symmetry"),
        (
            {"mirror": True, "algo_kwargs": {"use_sde": True}, "policy_kwargs": {"full_std": False}},
            "walk",
            "mirror: supp",
        ),
        ({"mirror": True, "algo": "sac"}, "walk", "mirror: supported only for PPO"),
        ({"mirror_loss": 0.5}, STOOL, "mirror_loss: tests.task.batches:Stool declares no mirror symmetry"),
        (
            {"algo": "recurrent_ppo", "policy_kwargs": {"shared_lstm": True, "enable_critic_lstm": False}},
            STOOL,
            "shared_lstm: the critic sees more than the actor",
        ),
        ({"policy_kwargs": {"policy_class": "own_nets.py:Policy"}}, STOOL, "policy_kwargs.policy_class"),
    ],
)
def test_what_is_not_supported_is_refused(train, settings, task, message):
    given = {"total_timesteps": 64, "n_envs": 2, "privileged": {}, "randomize": task in (STOOL, "walk"), **settings}
    if settings.get("algo") == "sac":
        given["algo_kwargs"] = {}
    with pytest.raises(RecipeError) as caught:
        train(task, given, **({"envs": ""} if task == STOOL else {}))
    assert message in str(caught.value)
