"""`rlctl train --demos`: behaviour cloning before the training, for every algorithm that has an actor."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import rlctl
from rlctl.environments.dict_spaces import take_row
from rlctl.errors import ArtifactError, UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import run_evaluation
from rlctl.launching.seeds import train_seeds
from rlctl.play.episode import load_episode
from rlctl.policy.file import PolicyFile
from rlctl.policy.load import load_policy
from rlctl.runs.directory import RunDirectory
from rlctl.runs.train_request import TrainRequest
from rlctl.training import demonstrations
from rlctl.training.loop import TrainingLoop
from tests.training.comparing import Killed, assert_same_run, rows
from tests.training.conftest import ENVS, TINY

SCRIPTS = """
import numpy as np

def to_the_origin(observation):
    x = observation["x"] if isinstance(observation, dict) else observation
    return np.clip(-2.5 * x, -1, 1)

def sign(observation):
    return int(observation[0] < 0)
"""
OFF_POLICY = {"learning_starts": 24, "batch_size": 16, "buffer_size": 200, "train_freq": 4, "gradient_steps": 2}
TINY_OFF_POLICY = {**TINY, "algo_kwargs": OFF_POLICY, "policy_kwargs": {"net_arch": [64, 64]}}
NORMALIZED = {"normalize": {"observation": True, "reward": True}}


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """Record a scripted policy, as `rlctl eval TASK --policy FILE:FUNCTION --record FOLDER` does."""
    folder = tmp_path_factory.mktemp("demos")
    script = folder / "scripts.py"
    script.write_text(SCRIPTS)

    def run(env: str, function: str = "to_the_origin") -> Path:
        target = folder / f"{env}-{function}"
        if not target.exists():
            task = f"{ENVS}:{env}"
            run_evaluation(EvalRequest(task, baseline=f"{script}:{function}", episodes=6, record=target))
        return target

    return run


@pytest.fixture
def changed(record, tmp_path):
    """Copy the demonstrations of the line with some arrays of the first one changed."""

    def change(env="Line", **arrays) -> Path:
        folder = tmp_path / "changed"
        shutil.copytree(record(env), folder)
        file = folder / "000000.npz"
        values = dict(np.load(file))
        np.savez(file, **values | {name: change(values[name]) for name, change in arrays.items()})
        return folder

    return change


def test_what_a_function_plays_is_recorded(record):
    files = sorted(record("Line").iterdir())
    assert [file.name for file in files] == [f"{number:06d}.npz" for number in range(6)]
    episode = load_episode(files[0])
    np.testing.assert_allclose(episode.actions, np.clip(-2.5 * episode.observations[:-1], -1, 1), rtol=1e-6)
    assert (episode.info.spec.task, episode.info.success) == (f"{ENVS}:Line", True)
    with pytest.raises(UsageError, match="exists already"):
        run_evaluation(EvalRequest(f"{ENVS}:Line", baseline="zero", episodes=1, record=files[0].parent))


def measure_error(policy, folder):
    """Return the root mean square of the differences between a policy's actions and those of demonstrations."""
    errors = []
    for file in folder.iterdir():
        episode = load_episode(file)
        for step, action in enumerate(episode.actions):
            errors.append(policy.predict(take_row(episode.observations, step)) - action)
    return np.sqrt(np.mean(np.square(errors)))


CASES = {
    "ppo": ("Line", TINY),
    "ppo with gSDE": ("Line", {**TINY, "algo_kwargs": {**TINY["algo_kwargs"], "use_sde": True}}),
    "ppo, dict": ("DictObservation", TINY),
    "a2c": ("Line", {**TINY, "algo": "a2c", "algo_kwargs": {"n_steps": 16}}),
    "sac": ("Line", {**TINY_OFF_POLICY, "algo": "sac"}),
    "sac with gSDE, normalised": (
        "Line",
        {**TINY_OFF_POLICY, **NORMALIZED, "algo": "sac", "algo_kwargs": {**OFF_POLICY, "use_sde": True}},
    ),
    "tqc": ("Line", {**TINY_OFF_POLICY, "algo": "tqc"}),
    "crossq": ("Line", {**TINY_OFF_POLICY, "algo": "crossq"}),
    "xqc": ("Line", {**TINY_OFF_POLICY, "algo": "xqc"}),
    "td3": ("Line", {**TINY_OFF_POLICY, "algo": "td3"}),
}


QUICK = {"ppo, dict", "sac with gSDE, normalised", "td3"}  # each in another branch of the cloning


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [case if case in QUICK else pytest.param(case, marks=pytest.mark.slow) for case in CASES]
)
def test_the_policy_of_step_0_acts_as_the_demonstrations(record, train, monkeypatch, capfd, case):
    monkeypatch.setattr(demonstrations, "_UPDATES", 800 if case in ("crossq", "xqc") else 300)
    env, settings = CASES[case]
    run = train(env, settings, demos=str(record(env))).run
    policy = load_policy(run.policy_file("0"))
    assert measure_error(policy, record(env)) < 0.1  # the actions range over 2
    assert rows(run.evals_file)[0]["steps"] == "0"
    assert "cloned 6 demonstrations (60 steps, mean error 0.0" in capfd.readouterr().err
    assert run.status()["demos"]["path"] == str(record(env))


@pytest.mark.slow
def test_discrete_actions_are_cloned(record, tmp_path):
    demos = record("Discrete", "sign")
    run = rlctl.train(f"{ENVS}:Discrete", demos=demos, root=tmp_path, check=False, **TINY).run
    policy = load_policy(run.policy_file("0"))
    assert [int(policy.predict(np.array([x], np.float32))) for x in (-0.3, -0.1, 0.1, 0.3)] == [1, 1, 0, 0]


@pytest.mark.slow
@pytest.mark.parametrize(("case", "name"), [("ppo", "log_std"), ("sac", "actor.log_std.bias")])
def test_noise_and_normalisation_after_cloning(record, train, monkeypatch, case, name):
    monkeypatch.setattr(demonstrations, "_UPDATES", 1)
    env, settings = CASES[case]
    run = train(env, {**settings, **NORMALIZED, "total_timesteps": 16}, demos=str(record(env))).run
    tensors = PolicyFile.read(run.policy_file("0")).tensors
    np.testing.assert_allclose(np.exp(tensors[f"policy/{name}"]), 0.1, rtol=1e-5)
    observations = np.concatenate([load_episode(file).observations[:-1] for file in sorted(record(env).iterdir())])
    # The first observations of the two environments are in it already, with the weight 2 / 16.
    assert abs(tensors["normalize//mean"] - observations.mean()) < 0.1
    assert 0.5 < tensors["normalize//var"] / observations.var() < 2.0


@pytest.mark.slow
def test_off_policy_updates_repeat_the_demonstrations(record, train, monkeypatch):
    monkeypatch.setattr(demonstrations, "_UPDATES", 300)
    env, settings = CASES["sac with gSDE, normalised"]
    settings = {**settings, "algo_kwargs": {**settings["algo_kwargs"], "learning_rate": 0.003, "gradient_steps": 8}}
    errors = []
    for share in (0.0, 2.0):
        monkeypatch.setattr(demonstrations, "REHEARSAL_SHARE", share)
        run = train(env, settings, demos=str(record(env))).run
        errors.append(measure_error(load_policy(run.last_policy), record(env)))
    without, with_rehearsal = errors
    assert with_rehearsal < 0.5 * without


@pytest.fixture
def kill_at(monkeypatch):
    """End the training at the first boundary after so many steps, before anything is written there."""
    boundary = TrainingLoop.boundary

    def kill(step):
        def run(loop):
            if loop.learner.steps >= step:
                raise Killed
            return boundary(loop)

        monkeypatch.setattr(TrainingLoop, "boundary", run)
        return lambda: monkeypatch.setattr(TrainingLoop, "boundary", boundary)

    return kill


@pytest.mark.slow
@pytest.mark.parametrize("case", ["ppo", "sac with gSDE, normalised"])
@pytest.mark.usefixtures("every_boundary")
def test_killed_and_resumed(record, changed, train, resume, monkeypatch, kill_at, case):
    monkeypatch.setattr(demonstrations, "_UPDATES", 50)
    monkeypatch.setattr(demonstrations, "REHEARSAL_SHARE", 1.0)
    env, settings = CASES[case]
    folder = changed()
    whole = train(env, settings, demos=str(folder)).run
    kill_at(0)  # cloned, and nothing saved yet
    with pytest.raises(Killed):
        train(env, settings, demos=str(folder))
    (run,) = (RunDirectory(path) for path in whole.path.parent.iterdir() if path != whole.path)
    assert run.checkpoints() == []
    undo = kill_at(64)
    with pytest.raises(Killed):
        resume(run)
    assert run.checkpoints() != []
    undo()
    file = folder / "000000.npz"
    content = file.read_bytes()
    file.unlink()
    if case != "ppo":  # which needs them no more
        with pytest.raises(ArtifactError, match="the demonstrations have changed since this training began"):
            resume(run)
        file.write_bytes(content)
    resume(run)
    assert_same_run(whole, run)


def test_seeds_share_the_demonstrations(record, tmp_path):
    request = TrainRequest(f"{ENVS}:Line", settings=TINY, demos=str(record("Line")), root=tmp_path, check=False)
    assert TrainRequest.from_json(request.to_json()) == request
    with pytest.raises(UsageError, match="--demos nowhere: no such file or folder"):
        train_seeds(TrainRequest(f"{ENVS}:Line", settings=TINY, demos="nowhere", root=tmp_path), "0-1")


def flip_success(info):
    return np.array(json.dumps({**json.loads(str(info)), "success": False}))


BAD = {
    "of another task": ("Discrete", {}, "000000.npz: an episode of the task .*:Line, not of .*:Discrete"),
    "not a number": (
        "Line",
        {"observations": lambda v: np.full_like(v, np.nan)},
        "an observation is not finite",
    ),
    "outside": ("Line", {"actions": lambda v: v + 3}, r"action \[.*\] of step 1 is outside the action space Box"),
    "other actions": (
        "Line",
        {"actions": lambda v: np.repeat(v, 2, 1)},
        r"its action has the shape \(2,\), the task's \(1,\)",
    ),
    "failed": ("Line", {"info": flip_success}, r"none of its episodes \(1\) succeeded: nothing to clone"),
}


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize("case", BAD)
def test_bad_episodes(changed, train, case):
    env, changes, message = BAD[case]
    with pytest.raises(ArtifactError, match=message):
        train(env, TINY, demos=str(changed(**changes) / "000000.npz"))


def test_a_truncated_file(changed, train):
    file = changed() / "000003.npz"
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(ArtifactError, match=r"000003\.npz: damaged, or not an \.npz file"):
        train("Line", TINY, demos=str(file.parent))


@pytest.mark.slow
def test_failed_episodes_are_left_out(changed, train, monkeypatch, capfd):
    monkeypatch.setattr(demonstrations, "_UPDATES", 10)
    train("Line", TINY, demos=str(changed(info=flip_success)))
    assert "cloned 5 demonstrations (50 steps" in capfd.readouterr().err


@pytest.mark.parametrize(("algo", "env"), [("dqn", "Discrete"), ("recurrent_ppo", "Line")])
def test_algorithms_that_cannot_clone(record, train, algo, env):
    with pytest.raises(UsageError, match=f"--demos: {algo} cannot clone demonstrations"):
        train(
            env,
            {**TINY, "algo": algo, "algo_kwargs": {}},
            demos=str(record(env, "sign" if algo == "dqn" else "to_the_origin")),
        )


def test_with_another_source(record, train):
    with pytest.raises(UsageError, match="--demos and --from exclude each other"):
        train("Line", TINY, demos=str(record("Line")), initial_policy="reach")


@pytest.mark.slow
def test_exit_codes(rlctl, tmp_path):
    task = f"{ENVS}:Line"
    empty = rlctl("train", task, "--demos", ".", "--no-check")
    assert empty.returncode == 5
    assert "no demonstrations: give an episode (.npz), a folder of episodes, or the folder" in empty.stderr
    assert "Traceback" not in empty.stderr
    for arguments in (["--demos", "nowhere"], ["--algo", "dqn", "--demos", "."]):
        refused = rlctl("train", task, *arguments)
        assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
