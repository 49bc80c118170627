"""Environments that go wrong in a training: what is reported, what is left running, and that the run can go on."""

import errno
import fcntl
import os

import psutil
import pytest

from rlctl.errors import TaskError
from rlctl.play import workers
from rlctl.training import checkpoint_file, checkpoints
from tests.training import faulty_envs
from tests.training.comparing import assert_same_run
from tests.training.conftest import FAULTY as ENVS
from tests.training.conftest import FAULTY_SEED as SEED
from tests.training.conftest import TINY

PLACE = f"in environment 1, episode seed {SEED}, step 7; "


pytestmark = pytest.mark.usefixtures("every_boundary")


@pytest.fixture(scope="module", autouse=True)
def _two_workers():
    """One environment each: what harms a worker is seen apart from what harms the other environment."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workers, "available_cores", lambda: 2)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The run that nothing stops."""
    from rlctl.launching.train import run_training
    from rlctl.runs.train_request import TrainRequest

    root = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoints, "CHECKPOINT_TIME_SHARE", 1e9)
        return run_training(
            TrainRequest(f"{ENVS}:Faulty", settings={**TINY, "task": {"fault": ""}}, root=root, check=False)
        ).run


# The same faults without a training, and many more, are in tests/play/test_returned_values.py.
ENDS = {
    "raise": "RuntimeError: the gripper fell off",
    "unprintable": "Unprintable: (message unavailable: ZeroDivisionError)",
    "exit": "SystemExit: 0",
    "nan reward": "ValueError: reward is nan",
    "_exit": "worker 1 ended with exit code 0 while stepping",
    "segfault": "worker 1 was killed by SIGSEGV while stepping",
    "abort": "worker 1 was killed by SIGABRT while stepping",
    "out of memory": "worker 1 was killed by SIGKILL while stepping: the system does that when memory runs out; "
    "fewer environments (--n-envs) need less",
}
HANGS = ("stopped", "endless", "sleep")
QUICK = ("raise", "out of memory")


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault",
    [each if each in QUICK else pytest.param(each, marks=pytest.mark.slow) for each in (*ENDS, *HANGS)],
)
@pytest.mark.usefixtures("no_child_left")
def test_a_fault_is_named_and_the_run_goes_on_after_it(fail, resume, monkeypatch, whole, fault):
    error, run = fail(fault=fault, timeout_s=3.0 if fault in HANGS else 60.0)
    message = ENDS.get(fault, "no answer for 3 s while stepping; if that may take so long, raise --env-timeout")
    assert str(error).splitlines() == [
        f"task '{ENVS}:Faulty': {message}",
        f"{PLACE}to reproduce it: rlctl replay {run.episode_file(0)}",
        f"checkpoint at step 64 is intact; resume with: rlctl train --resume {run.path}",
    ]
    assert error.exit_code == 3
    assert run.status()["status"] == "failed"
    assert [int(folder.name) for folder in run.checkpoints()][-1] == 64
    monkeypatch.setenv("MENDED", "1")
    resume(run)
    assert_same_run(whole, run)


@pytest.mark.slow
@pytest.mark.usefixtures("no_child_left")
def test_a_reset_that_fails_is_the_next_episodes(fail):
    error, _ = fail(fault="raise", at_reset=True)
    first, second, *_ = str(error).splitlines()
    assert first.endswith("RuntimeError: the gripper fell off")
    assert second.startswith(PLACE.replace("step 7", "step 0"))


@pytest.mark.slow
@pytest.mark.usefixtures("no_child_left")
def test_a_reset_that_hangs(fail):
    error, _ = fail(fault="sleep", at_reset=True, timeout_s=3.0)
    assert "no answer for 3 s while stepping" in str(error)
    assert ", step 0; " in str(error)


@pytest.mark.slow
def test_connections_closed_by_the_environment(fail):
    error, _ = fail(fault="closes files")
    assert "worker 1 ended with exit code 1 while " in str(error)


def test_an_environment_that_cannot_be_built_leaves_no_run(train, tmp_path):
    with pytest.raises(TaskError, match=r"RuntimeError: no licence \(tests/training/envs.py:"):
        train("Unbuilt", TINY)
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("no_child_left")
def test_bad_behaviour_changes_nothing(train, whole, capfd):
    run = train("Misbehaving", TINY, envs=ENVS).run
    assert_same_weights(whole, run)
    assert ["sleep", "300.0625"] not in [process.info["cmdline"] for process in psutil.process_iter(["cmdline"])]
    printed = capfd.readouterr().err
    assert "more lines printed by environments are left out" in printed
    assert "\x1b" not in printed
    assert "Traceback" not in printed


@pytest.mark.slow
def test_an_environment_that_cannot_be_closed_is_warned_of(train, capfd):
    train("Misbehaving", {**TINY, "total_timesteps": 32, "task": {"misbehaviour": "changes numpy's errors"}}, envs=ENVS)
    assert "warning: closing environment 0: RuntimeError: closed twice" in capfd.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("misbehaviour", faulty_envs.MISBEHAVIOUR)
@pytest.mark.usefixtures("no_child_left")
def test_one_kind_of_bad_behaviour_alone(train, whole, misbehaviour):
    assert_same_weights(whole, train("Misbehaving", {**TINY, "task": {"misbehaviour": misbehaviour}}, envs=ENVS).run)


def assert_same_weights(one, other):
    (ours, _), (theirs, _) = checkpoint_file.read_newest(one), checkpoint_file.read_newest(other)
    different = [name for name, values in ours.tensors.items() if values.tobytes() != theirs.tensors[name].tobytes()]
    assert different == []


def test_observations_outside_their_space_are_counted_and_reported(train, capfd):
    run = train("Outside", {**TINY, "total_timesteps": 64}, envs=ENVS).run
    printed = capfd.readouterr().err.splitlines()
    assert (
        "warning: observation is outside its space: element 0 is 12.5, not -10 to 10; "
        "such observations are counted and used unchanged"
    ) in printed
    # Each of two environments took 32 steps, in four episodes; three had a fifth step.
    assert run.status()["observations_outside"] == 2 * 3


@pytest.mark.slow
def test_a_file_system_without_locks_is_warned_of(train, monkeypatch, capfd):
    def flock(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", flock)
    run = train("Line", TINY).run
    assert f"warning: {run.path}: this file system has no locks: let only one process train this run" in (
        capfd.readouterr().err
    )
