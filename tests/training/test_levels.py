"""Levels that follow the success of each environment's own episodes."""

import csv
import dataclasses

import numpy as np
import pytest

from rlctl.errors import RecipeError, TaskError
from rlctl.play.episode import load_episode
from rlctl.play.messages import LevelRule
from rlctl.policy.file import PolicyFile
from rlctl.runs.directory import RunDirectory
from rlctl.training import checkpoint_file

pytest.importorskip("mujoco")

TASK = "tests.training.levelled:Levelled"
BATCH = "tests.training.levelled:LevelledBatch"
BROKEN = r"broken at level 0\.5"
SMALL = {
    "n_envs": 4,
    "total_timesteps": 128,
    "eval": {"episodes": 2, "every_steps": 128},
    "algo_kwargs": {"n_steps": 16, "batch_size": 32, "n_epochs": 1},
    "sim": "mujoco",
}


def following(**rule):
    return {**SMALL, "stages": [{"level": {"start": 0.0, "up": 0.25, "down": 0.1, **rule}}]}


def test_a_level_follows_success():
    rule = LevelRule(0.0, 0.3, 0.1)
    levels = [0.5]
    for success in (True, True, True, False, None):
        levels.append(rule.follow(levels[-1], success))
    assert levels == [0.5, 0.8, 1.0, 1.0, 0.9, 0.8]
    assert rule.follow(0.05, False) == 0.0


@pytest.mark.slow_except("tests.training.levelled:Levelled")
@pytest.mark.parametrize("task", [TASK, BATCH])
def test_what_is_mastered_gets_harder(train, task):
    # An episode takes 5 steps and succeeds up to level 0.6: 0, 0.25, 0.5, 0.75, then 0.65, then 0.55, 0.8 ..
    run = train(task, following(), envs="").run
    with run.metrics_file.open() as file:
        rows = list(csv.DictReader(file))
    # After 16 steps three episodes have ended, after 32 steps six.
    assert [float(row["level"]) for row in rows] == [0.75, 0.8]
    saved, _ = checkpoint_file.read_newest(run)
    assert saved.tensors["environments/level"].tolist() == [0.8] * 4
    (first, *_) = [load_episode(file) for file in sorted(run.episodes.glob("*.npz"))]
    assert first.info.spec.level == 1.0  # evaluations
    assert first.observations[0, 0] == 1.0  # what the task observes is its level


@pytest.mark.slow
def test_a_task_chooses_the_levels_of_its_episodes(train):
    run = train("tests.training.levelled:ChoosingBatch", following(start=0.5), envs="").run
    with run.metrics_file.open() as file:
        rows = list(csv.DictReader(file))
    # After 16 steps three episodes have ended, after 32 steps six: 0.5, 0.25, 0.125, 0.0625, .. (rounded to 4 places)
    assert [float(row["level"]) for row in rows] == [0.0625, 0.0078]


@pytest.mark.slow
def test_the_table_has_levels_if_a_later_stage_has(train):
    always = {"level": 0.2, "promote": {"return": -1000.0, "window": 1}}
    settings = {**SMALL, "stages": [always, {"level": {"start": 0.4, "up": 0.1}}]}
    with train(BATCH, settings, envs="").run.metrics_file.open() as file:
        rows = [(int(row["stage"]), float(row["level"])) for row in csv.DictReader(file)]
    assert rows[0] == (1, 0.2)
    assert rows[-1][0] == 2
    assert rows[-1][1] >= 0.4


@pytest.mark.slow
def test_the_episode_that_failed_is_reproduced_at_its_level(train, tmp_path):
    settings = {**following(), "task": {"faulty_level": 0.5}}
    with pytest.raises(TaskError, match=BROKEN):
        train(BATCH, settings, envs="")
    (run,) = (RunDirectory(path) for path in (tmp_path / "runs").rglob("*_s0"))
    (file,) = run.episodes.glob("*.npz")
    episode = load_episode(file)
    assert episode.info.spec.level == 0.5
    env = episode.info.spec.make()
    assert env.reset(seed=episode.info.seed)[0][0] == np.float32(0.5)
    for action in episode.actions[:-1]:
        env.step(action)
    with pytest.raises(RuntimeError, match=BROKEN):
        env.step(episode.actions[-1])


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize(
    ("task", "settings", "message"),
    [
        (BATCH, following(up=0), "level"),
        ("Line", {**following(), "sim": None}, "is a plain Gymnasium environment; only tasks have levels"),
        ("tests.training.levelled:Unjudged", following(), "does not report success, which it would follow"),
    ],
)
def test_what_is_not_supported_is_refused(train, task, settings, message):
    with pytest.raises(RecipeError) as caught:
        train(task, settings, **({} if task == "Line" else {"envs": ""}))
    assert message in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("task", [TASK, BATCH])
def test_a_level_is_for_training_only(train, task):
    run = train(task, {**SMALL, "stages": [{"level": 0.4}]}, envs="").run
    (first, *_) = [load_episode(file) for file in sorted(run.episodes.glob("*.npz"))]
    assert first.observations[0, 0] == 1.0  # of an evaluation
    policy = PolicyFile.read(run.best_policy)
    assert policy.info.derive_spec().level == 1.0
    stored = policy.with_info(spec=dataclasses.replace(policy.info.spec, level=0.4))
    assert stored.info.derive_spec().level == 1.0
