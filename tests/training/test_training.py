import csv
import json
import shutil
import sys

import numpy as np
import pytest

from rlctl import load_policy
from rlctl.errors import ArtifactError, DivergedError, TaskError, UsageError
from rlctl.launching.train import TrainResult, run_training
from rlctl.play.episode import load_episode
from rlctl.policy.actor import Rows
from rlctl.policy.file import PolicyFile
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.recipe import recipe as recipes
from rlctl.recipe import sources
from rlctl.runs.directory import RunDirectory
from rlctl.runs.summary import summarize
from rlctl.runs.train_request import TrainRequest
from rlctl.training import checkpoint_file
from tests import fork_server
from tests.training.conftest import ENVS, SMALL, SMALL_PPO


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> TrainResult:
    """A training that has ended; nobody writes to its run."""
    root = tmp_path_factory.mktemp("finished")
    return run_training(TrainRequest(f"{ENVS}:Line", settings=SMALL_PPO, root=root, check=False))


@pytest.fixture
def copied(finished, tmp_path) -> RunDirectory:
    """A copy of that run."""
    return RunDirectory(shutil.copytree(finished.run.path, tmp_path / "runs" / "Line" / finished.run.path.name))


def test_run_folder_holds_everything(finished):
    result = finished
    run = result.run
    status = run.status()
    assert status["status"] == "finished"
    assert status["steps"] == result.steps == 256
    assert run.recipe().algo_kwargs["n_steps"] == 16
    assert run.best_policy.is_file()
    assert run.last_policy.is_file()
    assert int(run.checkpoints()[-1].name) == 256
    assert list(run.tensorboard.iterdir())
    metrics = rows(run.metrics_file)
    assert [int(row["steps"]) for row in metrics] == [64, 128, 192, 256]
    assert all(float(row["approx_kl"]) >= 0 for row in metrics)
    # A new network's actions are of a normal distribution with a standard deviation of about 1, in [-1, 1]: 32 % of
    # them are beyond the limits.
    assert float(metrics[0]["exploration"]) == pytest.approx(1.0, rel=0.05)
    assert float(metrics[0]["action_saturation"]) == pytest.approx(0.32, abs=0.15)
    assert {row["terminated"] for row in metrics} == {"0.0"}
    assert all(float(row["gradient_norm"]) <= 0.5 + 1e-6 for row in metrics)
    evals = rows(run.evals_file)
    assert [int(row["steps"]) for row in evals] == [128, 256]
    # |x| stays below 0.4 + 10 * 0.01 = 0.5, so every episode succeeds.
    assert {float(row["success"]) for row in evals} == {1.0}


def test_tensorboard_has_distributions(finished):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(finished.run.tensorboard), size_guidance={"histograms": 0})
    events.Reload()
    first = events.Histograms("histograms/actions")[0]
    assert (first.step, first.histogram_value.num) == (64, 64)  # 4 environments played 16 steps
    assert [each.step for each in events.Scalars("train/approx_kl")] == [64, 128, 192, 256]
    assert [each.step for each in events.Scalars("eval/success_rate")] == [128, 256]
    assert events.Histograms("histograms/values")
    assert {"rollout/action_change", "rollout/exploration"} <= set(events.Tags()["scalars"])


def test_best_policy_is_that_of_the_best_evaluation(finished):
    result = finished
    best = max(rows(result.run.evals_file), key=lambda row: float(row["return"]))
    assert load_policy(result.run.best_policy).info.training_steps == int(best["steps"]) == result.best.training_steps


@pytest.mark.slow
def test_new_episodes_decide_between_the_best_and_the_last(train, capfd):
    kwargs = {"learning_rate": 0.01, "n_steps": 32, "batch_size": 32, "n_epochs": 5}
    result = train("Misleading", {**SMALL, "total_timesteps": 512, "algo_kwargs": kwargs})
    evals = rows(result.run.evals_file)
    assert float(evals[0]["return"]) > float(evals[-1]["return"])
    assert load_policy(result.run.best_policy).info.training_steps == 512
    assert result.run.status()["best_step"] == summarize(result.run.path).best_step == 512
    assert "30 new episodes: " in capfd.readouterr().err


def test_kept_episodes_are_the_first_and_the_worst(finished):
    files = sorted(finished.run.episodes.glob("*.npz"))
    assert 2 <= len(files) <= 4
    episode = load_episode(files[0])
    assert episode.actions.shape == (10, 1)
    assert episode.observations.shape == (11, 1)
    assert episode.info.total_reward == pytest.approx(episode.rewards.sum())


@pytest.mark.slow_except("a2c-Line", "dqn-Discrete")
@pytest.mark.parametrize(
    ("algo", "env"),
    [
        pytest.param("ppo", "Line", marks=pytest.mark.slow),
        pytest.param("ppo", "Discrete", marks=pytest.mark.slow),
        ("ppo", "DictObservation"),
        ("ppo", "Image"),
        ("a2c", "Line"),
        ("sac", "Line"),
        ("td3", "Line"),
        pytest.param("ddpg", "Line", marks=pytest.mark.slow),
        ("dqn", "Discrete"),
        ("tqc", "Line"),
        ("crossq", "Line"),
        ("xqc", "Line"),
        ("recurrent_ppo", "Line"),
    ],
)
def test_every_algorithm_trains_resumes_and_loads(train, resume, algo, env):
    kwargs = {"n_steps": 8} if algo in recipes.ON_POLICY else {"learning_starts": 16, "batch_size": 16}
    if algo in ("ppo", "recurrent_ppo"):
        kwargs |= {"batch_size": 16, "n_epochs": 2}
    network = {} if env == "Image" else {"policy_kwargs": {"net_arch": [16]}}
    result = train(env, {**SMALL, "algo": algo, "algo_kwargs": kwargs, "total_timesteps": 64, **network})
    assert result.steps == 64
    longer = resume(result, total_timesteps=96)
    assert longer.steps == 96
    steps = [int(row["steps"]) for row in rows(result.run.evals_file)]
    assert steps == sorted(set(steps))
    policy = load_policy(result.run.last_policy)
    assert policy.info.algo == algo
    assert policy.info.training_steps == 96
    assert policy.action_space.contains(policy.predict(policy.observation_space.sample()))


@pytest.mark.slow
def test_resume_goes_on_with_weights_optimiser_normalisation_and_counters(train, resume, small_ppo):
    first = train("Line", small_ppo)
    before, _ = checkpoint_file.read_newest(first.run)
    count = float(before.tensors["normalize//count"])
    # VecNormalize starts at 1e-4 and counts every observation once, resets included: 256 + 4.
    assert count == pytest.approx(260, abs=0.01)
    resume(first, total_timesteps=320)
    after, _ = checkpoint_file.read_newest(first.run)
    counters = after.state.model["counters"]
    assert counters["num_timesteps"] == after.state.step == 320
    assert counters["_n_updates"] == 2 * 5  # epochs x rollouts
    # 64 more: the episodes that were running go on, without a reset that would count.
    assert float(after.tensors["normalize//count"]) == pytest.approx(count + 64, abs=0.01)
    adam_steps = {float(value) for key, value in after.tensors.items() if key.endswith("/step")}
    assert adam_steps == {2.0 * 2 * 5}  # minibatches x epochs x rollouts
    # 80 steps an environment: eight episodes of ten ended, the ninth has just begun.
    assert after.tensors["environments/episodes_started"].tolist() == [9] * 4
    assert after.tensors["environments/steps"].tolist() == [0] * 4


def test_a_finished_run_without_checkpoints_does_not_begin_again(copied, resume):
    shutil.rmtree(copied.checkpoint(0).parent)
    before = copied.metrics_file.read_bytes()
    with pytest.raises(ArtifactError, match=r"finished, and its checkpoints were removed; .* --from "):
        resume(copied, total_timesteps=512)
    assert copied.metrics_file.read_bytes() == before


def test_resuming_a_finished_run_does_nothing(copied, resume):
    again = resume(copied)
    assert again.steps == 256
    assert "nothing to do" in again.note


def test_resume_takes_no_other_recipe(copied, resume):
    with pytest.raises(UsageError, match="algo cannot be changed; only -n can"):
        resume(copied, algo="sac")


def test_resume_falls_back_to_the_checkpoint_before_a_damaged_one(copied, resume, capsys):
    newest = copied.checkpoints()[-1] / "state.safetensors"
    content = bytearray(newest.read_bytes())
    content[-1] ^= 1
    newest.write_bytes(bytes(content))
    resume(copied)
    assert f"warning: {newest}: damaged: its content does not match its sha256; resuming from step " in (
        capsys.readouterr().err
    )
    assert (newest.parent.parent / "000000256.damaged").is_dir()
    assert [int(row["steps"]) for row in rows(copied.metrics_file)] == [64, 128, 192, 256]
    assert [int(row["steps"]) for row in rows(copied.evals_file)] == [128, 256]


@pytest.mark.slow
def test_stop_success_takes_two_evaluations_in_a_row(train, small_ppo):
    result = train("Line", {**small_ppo, "total_timesteps": 10_000, "stop_success": 0.98})
    assert result.steps == 256
    assert [int(row["steps"]) for row in rows(result.run.evals_file)] == [128, 256]


@pytest.mark.slow
def test_same_seed_gives_the_same_weights(train, small_ppo):
    weights = [
        PolicyFile.read(train("Line", {**small_ppo, "seed": seed}).run.last_policy).tensors for seed in (3, 3, 4)
    ]
    assert all((weights[0][key] == weights[1][key]).all() for key in weights[0])
    assert any((weights[0][key] != weights[2][key]).any() for key in weights[0])


@pytest.mark.slow_except("nan reward-ValueError: reward is nan")
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("raise", "RuntimeError: the gripper fell off"),
        ("nan reward", "ValueError: reward is nan"),
        ("nan observation", "ValueError: observation is not finite: element 0 is nan"),
        ("shape", r"ValueError: observation has shape \(2,\), the space has \(1,\)"),
    ],
)
def test_a_fault_of_the_environment_is_named_with_episode_and_step(train, small_ppo, fault, message):
    settings = {**small_ppo, "total_timesteps": 1000, "task": {"fault": fault, "episode": 8}}
    with pytest.raises(TaskError, match=message) as caught:
        train("Faulty", settings)
    assert "episode seed " in str(caught.value)
    assert "step 7" in str(caught.value)


@pytest.mark.slow
@pytest.mark.usefixtures("every_boundary")
def test_a_fault_leaves_the_last_boundary_to_resume_from(train, small_ppo, tmp_path):
    with pytest.raises(TaskError):
        train("Faulty", {**small_ppo, "total_timesteps": 1000, "task": {"episode": 8}})
    (status,) = (tmp_path / "runs").glob("*/*/run.json")
    assert json.loads(status.read_text())["status"] == "failed"
    # The eighth episode's seventh step is step 77 of an environment, in the fifth rollout of 16.
    assert (status.parent / "checkpoints" / "000000256").is_dir()


def test_a_worker_that_dies_ends_the_run(train, small_ppo):
    with pytest.raises(TaskError, match=r"worker \d ended with exit code 9 while stepping"):
        train("Faulty", {**small_ppo, "total_timesteps": 1000, "task": {"fault": "die"}})


def test_divergence_is_reported(train, small_ppo):
    settings = {**small_ppo, "total_timesteps": 2000, "normalize": {"observation": False, "reward": False}}
    settings["algo_kwargs"] = {**settings["algo_kwargs"], "learning_rate": 1.0, "max_grad_norm": 1e30}
    with pytest.raises(DivergedError, match=r"training diverged: .* not finite at step 64"):
        train("Exploding", settings)


def test_defaults_for_an_environment_without_a_recipe():
    resolved = sources.resolve(f"{ENVS}:Line", None, {})
    assert resolved.algo == "ppo"
    assert resolved.n_envs == 8
    assert 2048 <= resolved.n_envs * resolved.algo_kwargs["n_steps"] <= 16384


def test_live_policy_and_saved_policy_act_the_same(finished):
    policy = load_policy(finished.run.last_policy)
    episode = load_episode(sorted(finished.run.episodes.glob("*.npz"))[-1])
    if episode.info.policy != "training step 256":
        pytest.fail(f"the newest episode is of {episode.info.policy}")
    actions = np.stack([policy.predict(observation) for observation in episode.observations[:-1]])
    np.testing.assert_allclose(actions, episode.actions, atol=1e-6)
    observations = episode.observations[:-1]
    actor = NumpyActor(PolicyFile.read(finished.run.last_policy), len(observations))
    played = actor.act(observations, Rows.first(len(observations)))[1]
    np.testing.assert_array_equal(played, episode.actions)


@pytest.mark.slow
@pytest.mark.parametrize(
    "algo", ["ppo", pytest.param("sac", marks=pytest.mark.slow), pytest.param("a2c", marks=pytest.mark.slow)]
)
def test_torch_compiler_is_not_imported(algo, tmp_path):
    # It takes longer than the rest of the start.
    code = """
import sys
from rlctl.cli import build_app
try:
    build_app()()
finally:
    assert "torch._dynamo" not in sys.modules
"""
    command = [sys.executable, "-c", code, "train", f"{ENVS}:Line", "--no-check", "-o", str(tmp_path)]
    command += ["--algo", algo, "-n", "200", "--set", "n_envs=2", "--set", "eval.episodes=1"]
    done = fork_server.for_commands().run(command, timeout=250)
    assert done.returncode == 0, done.stderr
