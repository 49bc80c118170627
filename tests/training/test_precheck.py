"""The check before training: errors refuse, warnings are printed, everything else goes on."""

import pytest

from rlctl.errors import AnswerIsNo, TaskError


@pytest.fixture
def runs(tmp_path):
    return lambda: [path for path in (tmp_path / "runs").glob("[!l]*/*") if path.is_dir()]


def test_an_error_refuses_before_a_run_begins(train, runs, small_ppo):
    with pytest.raises(AnswerIsNo) as refused:
        train("Unseeded", small_ppo, check=True)
    first, fix, second = str(refused.value).splitlines()
    assert first.startswith("the check before training found 1 error: RL302 trajectory not repeatable (played twice by")
    assert fix.startswith("fix: ")
    assert second.startswith("rlctl check-env ")
    assert second.endswith("--no-check trains anyway.")
    assert runs() == []


@pytest.mark.slow
def test_an_environment_that_raises_has_the_exit_code_of_a_failed_task(train, runs, small_ppo, write_module):
    source = """
        from tests.training.envs import Line

        class Broken(Line):
            def step(self, action):
                raise OSError("no rlctl arm")
    """
    with pytest.raises(TaskError, match="the check before training found 1 error: RL207 raises"):
        train("Broken", small_ppo, envs=write_module("broken.py", source), check=True)
    assert runs() == []


@pytest.mark.slow
def test_without_the_check_it_trains(train, runs, small_ppo):
    assert train("Unseeded", small_ppo, check=False).steps == 256
    assert len(runs()) == 1


@pytest.mark.slow
def test_warnings_are_printed_and_training_goes_on(train, small_ppo, capsys):
    assert train("LargeRewards", small_ppo, check=True).steps == 256
    printed = capsys.readouterr().err
    assert "check before training: warnings RL603" in printed


def test_an_environment_that_cannot_be_built_is_the_workers_matter(train, small_ppo):
    with pytest.raises(TaskError, match="no licence"):
        train("Unbuilt", small_ppo, check=True)


@pytest.mark.slow  # the check plays until its time is over, and the evaluation for a million steps
def test_episodes_that_do_not_end_are_a_warning_before_the_training(train, small_ppo, write_module, capsys):
    source = """
        from tests.training.envs import Line

        class Endless(Line):
            def step(self, action):
                observation, reward, _, _, info = super().step(action)
                return observation, reward, False, False, info
    """
    with pytest.raises(TaskError, match="evaluations failed"):
        train("Endless", {**small_ppo, "eval": {"episodes": 1}}, envs=write_module("endless.py", source), check=True)
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: no episode ended")]
    assert (
        "steps of the check, and an evaluation fails if an episode does not end. Wrap it in gymnasium.wrappers" in line
    )
    assert "--set" not in line  # it is no Gymnasium id
