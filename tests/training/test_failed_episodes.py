"""The episode in which an environment failed is stored, and reproduced."""

import pytest

from rlctl.errors import TaskError, UsageError
from rlctl.play.episode import load_episode
from rlctl.replaying.replay import run_replay
from rlctl.replaying.replay_request import ReplayRequest
from tests.training.conftest import FAULTY, FAULTY_SEED, TINY

pytestmark = pytest.mark.usefixtures("every_boundary", "no_child_left")


def lived_again(file):
    with pytest.raises(TaskError) as caught:
        run_replay(ReplayRequest(str(file)))
    return str(caught.value)


CASES = {
    "plain": ("Faulty", {}, {}),
    "dict": ("FaultyDict", {}, {}),
    "discrete": ("FaultyDiscrete", {}, {}),
    "frame stack": ("Faulty", {"frame_stack": 3}, {}),
    "out of memory": ("Faulty", {}, {"fault": "out of memory"}),
    "reset": ("Faulty", {}, {"at_reset": True}),
}


QUICK = ("plain", "discrete", "reset")


@pytest.mark.slow_except("plain")
@pytest.mark.parametrize(
    "case", [case if case in QUICK else pytest.param(case, marks=pytest.mark.slow) for case in CASES]
)
def test_it_fails_again_as_it_did(fail, rlctl, case):
    env, settings, parameters = CASES[case]
    error, run = fail(env, {**TINY, **settings}, **{"fault": "raise", **parameters})
    first, place, *_ = str(error).splitlines()
    file = run.episode_file(0)
    assert place.endswith(f"; to reproduce it: rlctl replay {file}")
    episode = load_episode(file)
    assert episode.info.failure == first
    assert episode.info.seed == FAULTY_SEED
    assert len(episode.actions) == (0 if case == "reset" else 7)
    again, place_again = lived_again(file).splitlines()
    assert again.replace("worker 0", "worker 1") == first.replace("worker 0", "worker 1")  # one core has one worker
    assert place_again.replace("environment 0", "environment 1").partition(";")[0] == place.partition(";")[0]
    with pytest.raises(UsageError, match=r"the episode failed \(task .*\), so there is nothing to compare"):
        run_replay(ReplayRequest(None, verify=file))


@pytest.mark.slow
def test_the_command_that_the_error_names(rlctl, tmp_path):
    arguments = ["train", f"{FAULTY}:Faulty", "--no-check", "-n", "128", "--n-envs", "2"]
    settings = [f"task.faulty_seed={FAULTY_SEED}", "task.fault=raise", "algo_kwargs.n_steps=16", "eval.episodes=1"]
    trained = rlctl(*arguments, *(part for each in settings for part in ("--set", each)))
    assert trained.returncode == 3, trained.stderr
    assert trained.stdout == ""
    printed = trained.stderr.splitlines()
    # The environment's own traceback comes first, and no line of it is rlctl's.
    (begin,) = (number for number, line in enumerate(printed) if line.startswith("Traceback"))
    error = next(number for number, line in enumerate(printed) if line.startswith("error: "))
    assert not [line for line in printed[begin:error] if "/rlctl/" in line]
    was_due = printed[-1].startswith("the checkpoint of step ")
    assert len(printed) - error == (3 if was_due else 2)
    command = printed[error + 1].partition(": rlctl ")[2].split()
    replayed = rlctl(*command)
    assert replayed.returncode == 3
    assert "RuntimeError: the gripper fell off" in replayed.stderr
    assert rlctl("replay", "--verify", command[-1]).returncode == 2
    mended = rlctl(*command, env={"MENDED": "1"})
    assert mended.returncode == 0, mended.stderr
    assert "it failed when it was recorded (task " in mended.stderr
    assert "), but not when it was replayed" in mended.stderr


@pytest.mark.slow
def test_it_is_of_the_stage_it_was_in(fail):
    rule = {"promote": {"success": 0.5, "window": 2}}
    settings = {**TINY, "stages": [{"task": {"last": False}, **rule}, {"task": {"last": True}}]}
    error, run = fail("FaultyStages", settings, fault="raise")
    assert load_episode(run.episode_file(0)).info.spec.parameters["last"] is True
    assert "the gripper fell off" in lived_again(run.episode_file(0))
    assert error.exit_code == 3


@pytest.mark.slow
def test_actions_for_another_space(fail):
    from rlctl.errors import ArtifactError
    from rlctl.play.episode import save_episode

    _, run = fail(fault="raise")
    file = run.episode_file(0)
    episode = load_episode(file)
    save_episode(file, type(episode)(**{**vars(episode), "actions": episode.actions.repeat(2, axis=1)}))
    with pytest.raises(ArtifactError, match=r"its actions have shape \(2,\), but those of .* have \(1,\)"):
        run_replay(ReplayRequest(str(file)))
