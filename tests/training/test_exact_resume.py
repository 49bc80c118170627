"""A run that was killed and resumed is the run that was never stopped, bit for bit."""

import pytest
import torch

from rlctl.play.workers import available_cores
from rlctl.recipe import recipe as recipes
from rlctl.training import checkpoints
from tests.training.comparing import Killed, assert_same_run, rows
from tests.training.conftest import FAULTY, SMALL

ON_POLICY = {"ppo": {"n_steps": 16, "batch_size": 32, "n_epochs": 2}, "a2c": {"n_steps": 16}}
ON_POLICY["recurrent_ppo"] = ON_POLICY["ppo"]
OFF_POLICY = {"learning_starts": 24, "batch_size": 16, "buffer_size": 200, "train_freq": 4, "gradient_steps": 2}
SHORT = {"total_timesteps": 128, "eval": {"episodes": 3, "every_steps": 64}}


def settings(algo, **changes):
    if algo in ON_POLICY:
        return recipes.merge({**SMALL, "algo": algo, "algo_kwargs": ON_POLICY[algo]}, changes)
    given = {**SMALL, **SHORT, "algo": algo, "algo_kwargs": OFF_POLICY, "policy_kwargs": {"net_arch": [16]}}
    return recipes.merge(given, changes)


SDE = {"algo_kwargs": {"use_sde": True}}
NORMALIZED = {"normalize": {"observation": True, "reward": True}}
STAGES = {
    "stages": [{"task": {"tolerance": 0.5}, "promote": {"success": 0.5, "window": 6}}, {"task": {"tolerance": 0.3}}]
}
LEVELS = {
    "stages": [{"level": {"start": 0.1, "up": 0.3, "down": 0.2}}],
    "events": {"mass": {"factor": {"from": [1.0, 1.0], "to": [0.5, 2.0]}}, "kick": {}},
}
WIDE = {"policy_kwargs": {"net_arch": [128, 128]}}
STOOL = "tests.task.batches:Stool"
CASES = {
    "ppo": ("Line", settings("ppo")),
    "ppo with gSDE": ("Line", settings("ppo", **SDE)),
    "ppo, resampled gSDE": ("Line", settings("ppo", algo_kwargs={"use_sde": True, "sde_sample_freq": 4})),
    "ppo, falling rate": ("Line", settings("ppo", algo_kwargs={"learning_rate": "lin_1e-3", "clip_range": "lin_0.2"})),
    "ppo, discrete": ("Discrete", settings("ppo")),
    "ppo, dict": ("DictObservation", settings("ppo")),
    "ppo, image": ("Image", settings("ppo", total_timesteps=192)),
    "ppo, frame stack": ("Line", settings("ppo", frame_stack=3)),
    "ppo, curriculum": ("Staged", settings("ppo", **STAGES)),
    "ppo, stochastic evaluation": ("Line", settings("ppo", eval={"deterministic": False}, **SDE)),
    "ppo, other observations than declared": (f"{FAULTY}:Outside", settings("ppo")),
    "ppo, on reach": ("reach", settings("ppo", n_envs=2, total_timesteps=128, eval=SHORT["eval"])),
    "ppo, on worlds in batches": (STOOL, settings("ppo", randomize=True)),
    "recurrent_ppo, on worlds in batches": (STOOL, settings("recurrent_ppo", policy_kwargs={"lstm_hidden_size": 8})),
    "ppo, privileged, on worlds in batches": (STOOL, settings("ppo", randomize=True, privileged={})),
    "ppo, mirrored": ("walk", settings("ppo", mirror=True, randomize=True, task={"episode_s": 0.4})),
    "ppo, mirrored, with a history": (
        "walk-rough",
        settings(
            "ppo",
            mirror=True,
            privileged={},
            observe=["gyroscope", "joint_positions", "velocity"],
            observation_history={"joint_positions": 2},
            task={"episode_s": 0.4},
        ),
    ),
    "ppo, levels, on worlds in batches": (STOOL, settings("ppo", **LEVELS)),
    "ppo, levels that the task chooses": (
        "rlctl_locomotion.follow:QuadrupedBow",
        settings("ppo", task={"episode_s": 0.4, "tolerance": 0.0}, stages=[{"level": {"start": 1.0}}]),
    ),
    "sac, levels": (STOOL, settings("sac", **LEVELS)),
    "ppo, privileged, on reach": (
        "reach",
        settings("ppo", n_envs=2, total_timesteps=128, eval=SHORT["eval"], randomize=True, privileged={}),
    ),
    "sac, privileged": (STOOL, settings("sac", randomize=True, privileged={}, **NORMALIZED)),
    "recurrent_ppo, privileged": (
        STOOL,
        settings("recurrent_ppo", randomize=True, privileged={}, policy_kwargs={"lstm_hidden_size": 8}),
    ),
    "recurrent_ppo, privileged, one LSTM": (
        STOOL,
        settings("recurrent_ppo", privileged={}, policy_kwargs={"lstm_hidden_size": 8, "enable_critic_lstm": False}),
    ),
    "tqc, privileged": (STOOL, settings("tqc", randomize=True, privileged={"task": False})),
    "ppo, on hopper": ("hopper", settings("ppo", n_envs=2, total_timesteps=128, eval=SHORT["eval"])),
    "a2c": ("Line", settings("a2c")),
    "recurrent_ppo": ("Line", settings("recurrent_ppo", policy_kwargs={"lstm_hidden_size": 8})),
    "sac": ("Line", settings("sac", algo_kwargs={"train_freq": 1}, policy_kwargs={"net_arch": [256, 256]})),
    "sac, frame stack": ("Line", settings("sac", frame_stack=3, algo_kwargs={"buffer_size": 60})),
    "sac, histories": (
        STOOL,
        settings("sac", randomize=True, observation_history={"hips": 3, "seen": 2}, algo_kwargs={"buffer_size": 60}),
    ),
    "sac with gSDE": ("Line", settings("sac", **SDE)),
    "sac, normalised": ("Line", settings("sac", **NORMALIZED)),
    "sac, dict": ("DictObservation", settings("sac", **NORMALIZED)),
    "sac, curriculum": ("Staged", settings("sac", **STAGES)),
    "sac, several steps": ("Line", settings("sac", algo_kwargs={"n_steps": 3})),
    "sac, one environment": ("Line", settings("sac", n_envs=1)),
    "sac, hindsight": ("Plane", settings("sac", her={}, task={"steps": 7})),
    "sac, hindsight, normalised": ("Plane", settings("sac", her={}, task={"steps": 7}, **NORMALIZED)),
    "dqn, hindsight": ("Corridor", settings("dqn", her={"goal_selection_strategy": "final"}, task={"steps": 7})),
    "td3": ("Line", settings("td3")),
    "ddpg": ("Line", settings("ddpg")),
    "dqn": ("Discrete", settings("dqn", algo_kwargs={"target_update_interval": 20})),
    "tqc": ("Line", settings("tqc")),
    "crossq": ("Line", settings("crossq")),
    "xqc": ("Line", settings("xqc")),
    "xqc, hindsight": ("Plane", settings("xqc", her={}, task={"steps": 7})),
    "xqc, privileged": (STOOL, settings("xqc", randomize=True, privileged={"task": False})),
    # Minibatches of four blocks, 128 rows * 34,000 weights, and of two, 64 / 32 rows.
    "ppo, blocks": ("Line", settings("ppo", algo_kwargs={"n_steps": 32, "batch_size": 128}, **WIDE)),
    "tqc, blocks": ("Line", settings("tqc", algo_kwargs={"batch_size": 64}, **WIDE)),
}
# A kind of state each: noise matrices, stages, whole episodes with their goals and statistics. Killed
# trainings of plain ppo and sac are in tests/crash.
QUICK = {
    *("ppo with gSDE", "ppo, curriculum", "sac, hindsight, normalised"),
}


# Takes seconds, and runs in every `make test`: exact resume, on and off policy.
@pytest.mark.slow_except("ppo with gSDE")
@pytest.mark.parametrize(
    "case", [case if case in QUICK else pytest.param(case, marks=pytest.mark.slow) for case in CASES]
)
@pytest.mark.usefixtures("every_boundary")
def test_killed_and_resumed(train, resume, kill_after, case):
    kill_and_resume(train, resume, kill_after, case, "cpu")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("case", ["ppo", "recurrent_ppo", "sac", "sac with gSDE", "td3", "dqn", "tqc", "crossq", "xqc"])
@pytest.mark.usefixtures("every_boundary")
def test_on_a_gpu(train, resume, kill_after, case):
    kill_and_resume(train, resume, kill_after, case, "cuda")


def kill_and_resume(train, resume, kill_after, case, device):
    env, given = CASES[case]
    whole = train(env, given, device=device).run
    undo = kill_after(0)  # in the first step
    with pytest.raises(Killed):
        train(env, given, device=device)
    undo()
    run = newest_other_than(whole)
    assert [int(each.name) for each in run.checkpoints()] == [0]
    for steps in (37, 11) if given["algo"] in ON_POLICY else (13, 5):
        undo = kill_after(steps)
        with pytest.raises(Killed):
            resume(run, device=device)
        undo()
        assert int(run.checkpoints()[-1].name) > 0
    resume(run, device=device)
    assert_same_run(whole, run)


@pytest.mark.slow
@pytest.mark.parametrize(("case", "steps"), [("ppo", 37), ("ppo, blocks", 37), ("tqc, blocks", 13)])
@pytest.mark.usefixtures("every_boundary")
def test_on_one_core_and_resumed_on_all(train, resume, kill_after, use_cores, case, steps):
    env, given = CASES[case]
    whole = train(env, given).run
    undo = kill_after(steps)
    with use_cores(1):
        assert available_cores() == 1
        with pytest.raises(Killed):
            train(env, given)
    undo()
    run = newest_other_than(whole)
    with use_cores():
        resume(run)
    assert_same_run(whole, run)


def newest_other_than(run):
    from rlctl.runs.directory import RunDirectory

    (other,) = (each for each in run.path.parent.iterdir() if each != run.path)
    return RunDirectory(other)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "steps", "evaluated"), [("ppo", 40, "128"), pytest.param("dqn", 20, "64", marks=pytest.mark.slow)]
)
def test_an_evaluation_after_the_last_checkpoint(train, resume, kill_after, monkeypatch, case, steps, evaluated):
    monkeypatch.setattr(checkpoints, "CHECKPOINT_TIME_SHARE", 1e-9)
    env, given = CASES[case]
    whole = train(env, given).run
    undo = kill_after(steps)
    with pytest.raises(Killed):
        train(env, given)
    undo()
    run = newest_other_than(whole)
    assert [int(each.name) for each in run.checkpoints()] == [0]
    assert [row["steps"] for row in rows(run.evals_file)] == [evaluated]
    resume(run)
    assert_same_run(whole, run)
