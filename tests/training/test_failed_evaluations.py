"""Evaluations that fail: the training goes on, and does not forget it."""

import pytest

from rlctl.errors import ArtifactError, TaskError, UsageError
from rlctl.play.episode import load_episode
from rlctl.play.seeds import Stream, episode_seeds
from rlctl.replaying.replay import run_replay
from rlctl.replaying.replay_request import ReplayRequest
from rlctl.runs import lookup
from tests.training.comparing import Killed, rows
from tests.training.conftest import FAULTY, TINY

pytestmark = pytest.mark.usefixtures("every_boundary", "no_child_left")

(SEED,) = episode_seeds(0, Stream.EVAL_IN_TRAINING, 1)


@pytest.fixture
def settings(tmp_path):
    """Evaluations at 32, 64, 96 and 128; those in `which` fail."""

    def of(*which, fault="raise", **changes):
        task = {"log": str(tmp_path / "log"), "which": which, "seed": SEED, "fault": fault}
        return {**TINY, "task": task, "eval": {"episodes": 1, "every_steps": 32}, **changes}

    return of


def only_run(tmp_path):
    return lookup.find_run("latest", tmp_path / "runs")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("raise", "RuntimeError: the gripper fell off"),
        pytest.param("out of memory", "worker 0 was killed by SIGKILL while stepping: ", marks=pytest.mark.slow),
        pytest.param("sleep", "no answer for 3 s while stepping", marks=pytest.mark.slow),
    ],
)
def test_training_goes_on(train, settings, tmp_path, capfd, fault, message):
    with pytest.raises(TaskError) as caught:
        train("FailsWhenEvaluated", settings(2, 3, fault=fault), envs=FAULTY, env_timeout_s=3.0)
    run = only_run(tmp_path)
    first, place = str(caught.value).splitlines()
    assert first.startswith(
        f"{run.path}: the training is done, but 2 of its evaluations failed, the first at step 64: task "
    )
    assert message in first
    assert place.startswith(f"in environment 0, episode seed {SEED}, step 7; ")
    assert caught.value.exit_code == 3
    assert run.status()["status"] == "finished"
    assert run.status()["failed_evaluations"] == 2
    assert [row["steps"] for row in rows(run.evals_file)] == ["32", "128"]
    assert [row["steps"] for row in rows(run.metrics_file)] == ["32", "64", "96", "128"]
    assert run.best_policy.exists()
    printed = capfd.readouterr().err
    assert printed.count("failed, training continues: task ") == 2
    kept = [file for file in sorted(run.episodes.glob("*.npz")) if load_episode(file).info.failure]
    assert [load_episode(file).info.policy for file in kept] == ["training step 64", "training step 96"]
    assert all(len(load_episode(file).actions) == 7 for file in kept)
    assert f"to reproduce it: rlctl replay {kept[0]}" in printed


@pytest.mark.slow
def test_it_can_be_replayed(train, settings, tmp_path):
    # Each life is counted: the first is the one evaluation, the second and third may be the replay's.
    with pytest.raises(TaskError):
        train("FailsWhenEvaluated", settings(1, 2, 3, total_timesteps=32), envs=FAULTY)
    (file,) = only_run(tmp_path).episodes.glob("*.npz")
    with pytest.raises(TaskError, match="RuntimeError: the gripper fell off"):
        run_replay(ReplayRequest(str(file)))


@pytest.mark.slow
def test_none_ever_succeeded(train, settings, tmp_path, rlctl):
    with pytest.raises(TaskError, match="4 of its evaluations failed, the first at step 32"):
        train("FailsWhenEvaluated", settings(1, 2, 3, 4), envs=FAULTY)
    run = only_run(tmp_path)
    assert not run.evals_file.exists()
    with pytest.raises(ArtifactError, match="no best policy yet; train longer, or use --checkpoint last"):
        lookup.find_policy("latest", root=tmp_path / "runs")
    assert run.last_policy.exists()


@pytest.mark.slow
def test_a_resume_remembers(train, resume, settings, tmp_path, monkeypatch):
    from rlctl.training.checkpoints import Checkpoints

    def killed(saver, *arguments, **options):
        saved = original(saver, *arguments, **options)
        if saver.saved_step == 96:
            raise Killed
        return saved

    original = Checkpoints.save
    monkeypatch.setattr(Checkpoints, "save", killed)
    with pytest.raises(Killed):
        train("FailsWhenEvaluated", settings(2), envs=FAULTY)
    monkeypatch.undo()
    run = only_run(tmp_path)
    with pytest.raises(TaskError, match="1 of its evaluations failed, the first at step 64"):
        resume(run)
    assert [row["steps"] for row in rows(run.evals_file)] == ["32", "96", "128"]
    with pytest.raises(TaskError, match="1 of its evaluations failed"):  # nothing to do is not all well
        resume(run)


@pytest.mark.slow
def test_the_task_is_removed_while_training(train, resume, tmp_path, settings):
    """Then no fresh environment can be built, and those that are there go on."""
    task = tmp_path / "mine.py"
    task.write_text(
        f"import sys; sys.path.append({str(FAULTY.parent)!r})\n"
        "import os, faulty_envs\n"
        "class Mine(faulty_envs.FailsWhenEvaluated):\n"
        "    def step(self, action):\n"
        "        if self.faulty:\n"
        "            os.rename(__file__, __file__ + '.gone')\n"
        "        return super().step(action)\n"
    )
    with pytest.raises(TaskError, match="3 of its evaluations failed, the first at step 64"):
        train("Mine", settings(2), envs=task)
    run = only_run(tmp_path)
    assert [row["steps"] for row in rows(run.evals_file)] == ["32"]
    with pytest.raises(UsageError, match=r"mine.py no longer exists\. The policy may no longer fit"):
        resume(run)
