"""A task, its plugin or a library is another one when a run is resumed."""

import os
import shutil
import signal
import sys

import numpy as np
import pytest

from rlctl.errors import ArtifactError, Interrupted, TaskError, UsageError
from rlctl.runs import lookup
from rlctl.training import checkpoint_file
from tests.training.comparing import Killed, assert_same_run, replay_buffer, rows
from tests.training.conftest import ENVS, TINY

pytestmark = pytest.mark.usefixtures("every_boundary")

PLUGIN = """
from tests.training.envs import Staged
class Mine(Staged):
    size = 1
    def __init__(self):
        super().__init__(size=self.size)
"""


@pytest.fixture
def kill_at(monkeypatch):
    """End a training right after the checkpoint of a step."""
    from rlctl.training.checkpoints import Checkpoints

    def kill(step):
        original = Checkpoints.save

        def checkpoint(saver, *arguments, **options):
            original(saver, *arguments, **options)
            if saver.saved_step == step:
                monkeypatch.setattr(Checkpoints, "save", original)
                raise Killed

        monkeypatch.setattr(Checkpoints, "save", checkpoint)

    return kill


@pytest.fixture
def killed(train, kill_at, tmp_path):
    """Train until the checkpoint of step 64; return the run."""

    def run(env, settings=TINY, **request):
        kill_at(64)
        with pytest.raises(Killed):
            train(env, settings, **request)
        return lookup.find_run("latest", tmp_path / "runs")

    return run


@pytest.fixture
def plugin(install, monkeypatch, killed):
    """Train the task `mine` of an installed plugin, version 1.2; return its folder and the run."""
    monkeypatch.delitem(sys.modules, "mine_plugin", raising=False)
    folder = install("mine-plugin", {"mine": "mine_plugin:Mine"}, {"mine_plugin.py": PLUGIN})
    monkeypatch.syspath_prepend(folder)
    return folder, killed("mine")


def upgrade(folder, version="1.3"):
    (metadata,) = folder.glob("*.dist-info")
    text = (metadata / "METADATA").read_text().replace("Version: 1.2", f"Version: {version}")
    (metadata / "METADATA").write_text(text)
    metadata.rename(metadata.with_name(f"mine_plugin-{version}.dist-info"))


def change(folder, before, after):
    file = folder / "mine_plugin.py"
    text = file.read_text()
    assert before in text
    file.write_text(text.replace(before, after))
    shutil.rmtree(folder / "__pycache__", ignore_errors=True)


CHANGES = {
    "upgraded": (upgrade, "task mine came from mine-plugin 1.2 when the run began, and comes from mine-plugin 1.3 now"),
    "edited": (
        lambda folder: change(folder, "size = 1", "size = 1  # "),
        "{folder}/mine_plugin.py has changed since the run began",
    ),
}


@pytest.mark.slow_except("upgraded")
@pytest.mark.parametrize("what", CHANGES)
def test_another_task_is_refused_unless_forced(plugin, resume, capfd, what):
    folder, run = plugin
    does, message = CHANGES[what]
    message = message.format(folder=folder)
    does(folder)
    before = run.status_file.read_bytes()
    with pytest.raises(UsageError) as caught:
        resume(run)
    assert str(caught.value) == (f"{run.path}: {message}. The policy may no longer fit; --force resumes anyway")
    assert run.status_file.read_bytes() == before
    resume(run, force=True)
    assert f"resuming at step 64, not bit-exact: {message}" in capfd.readouterr().err.splitlines()
    assert run.status()["status"] == "finished"
    assert [row["steps"] for row in rows(run.metrics_file)] == ["32", "64", "96", "128"]


@pytest.mark.slow
def test_a_plugin_that_is_gone(plugin, resume):
    folder, run = plugin
    before = run.status_file.read_bytes()
    shutil.rmtree(folder)
    sys.modules.pop("mine_plugin")
    with pytest.raises(UsageError, match=r"came from mine-plugin 1\.2 when the run began, and comes from no installed"):
        resume(run)
    with pytest.raises(UsageError, match=r"no task 'mine'\."):
        resume(run, force=True)
    assert run.status_file.read_bytes() == before


@pytest.mark.slow
def test_other_spaces(plugin, resume):
    folder, run = plugin
    change(folder, "size = 1", "size = 2")
    with pytest.raises(ArtifactError) as caught:
        resume(run, force=True)
    assert "its observation space is Box(-10.0, 10.0, (1,), float32)" in str(caught.value)
    assert "Box(-10.0, 10.0, (2,), float32)" in str(caught.value)
    assert caught.value.exit_code == 5
    change(folder, "size = 2", "size = 1")
    resume(run)  # nothing was touched
    assert run.status()["status"] == "finished"


@pytest.mark.slow
def test_other_libraries_are_named(killed, resume, monkeypatch, capfd):
    versions = checkpoint_file.collect_versions
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint_file, "collect_versions", lambda: {**versions(), "torch": "1.0", "numpy": "1.26.4"})
        run = killed("Line")
    resume(run)
    now = versions()
    assert (
        f"resuming at step 64, not bit-exact: torch 1.0 -> {now['torch']}; numpy 1.26.4 -> {now['numpy']}"
    ) in capfd.readouterr().err.splitlines()
    assert run.status()["status"] == "finished"


# Every tenth transition is the last of an episode, the thirty-second was cut short, and then they begin anew.
TIMEOUTS = [9, 19, 29, 31, 41, 51, 61]
SAC = {
    **TINY,
    "algo": "sac",
    "algo_kwargs": {"learning_starts": 8, "batch_size": 8, "buffer_size": 100, "train_freq": 4},
    "policy_kwargs": {"net_arch": [16]},
}


@pytest.mark.slow
@pytest.mark.parametrize("settings", [pytest.param(TINY, marks=pytest.mark.slow), SAC], ids=["ppo", "sac"])
def test_an_environment_that_no_seed_reaches_begins_new_episodes(killed, resume, capfd, settings):
    run = killed("Unseeded", settings)
    before, _ = checkpoint_file.read_newest(run)
    resume(run)
    printed = capfd.readouterr().err
    assert (
        "resuming at step 64, not bit-exact: environment 0 did not reach its saved state from its seed "
        "and actions, so all environments start new episodes"
    ) in printed
    after, damage = checkpoint_file.read_newest(run)
    assert damage == []
    assert after.state.step == 128
    if settings is SAC:
        transitions = replay_buffer(run, after.state.segments)
        assert sorted(transitions) == list(range(64))  # of two environments each
        # What was cut short in the middle of an episode is marked, so that no return reaches over it.
        assert [number for number in transitions if transitions[number]["timeouts/"].any()] == TIMEOUTS
    assert (before.tensors["environments/episodes_started"] == [4, 4]).all()
    # 32 steps more of each: the fourth is left, the fifth to seventh are whole, and the eighth runs.
    assert (after.tensors["environments/episodes_started"] == [8, 8]).all()
    resume(run, total_timesteps=160)  # and it can be gone on with


@pytest.mark.slow
def test_an_environment_that_fails_in_the_replay_begins_new_episodes(killed, resume, tmp_path, capfd, write_module):
    file = write_module(
        "fragile.py",
        f"""
        import os, sys; sys.path.append({str(ENVS.parent)!r})
        from tests.training.envs import Line
        class Fragile(Line):
            def step(self, action):
                if os.path.exists({str(tmp_path / "fragile")!r}) and self.steps == 1:
                    os.remove({str(tmp_path / "fragile")!r})
                    raise RuntimeError("the gripper fell off")
                return super().step(action)
        """,
    )
    run = killed("Fragile", envs=file)
    (tmp_path / "fragile").touch()
    resume(run)
    printed = capfd.readouterr().err
    assert "RuntimeError: the gripper fell off in environment " in printed
    assert ", step 2, when it was replayed" in printed
    assert "did not reach its saved state from its seed and actions, so all environments start new episodes" in printed
    assert run.status()["status"] == "finished"


@pytest.fixture
def intrusive(write_module):
    """A task whose import changes what it can."""
    return write_module(
        "intrusive.py",
        f"""
        import os, signal, sys; sys.path.append({str(ENVS.parent)!r})
        import numpy as np
        from tests.training.envs import Line
        os.chdir("/")
        np.seterr(all="raise")
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        class Intrusive(Line):
            pass
        """,
    )


@pytest.mark.slow
def test_an_import_changes_nothing_of_ours(train, intrusive):
    folder, errors = os.getcwd(), np.geterr()
    whole = train("Line", TINY).run
    run = train("Intrusive", TINY, envs=intrusive).run
    assert os.getcwd() == folder
    assert np.geterr() == errors
    assert_same_run(whole, run)


@pytest.mark.slow
def test_an_import_does_not_take_signals_from_a_training(train, intrusive, monkeypatch):
    from rlctl.training.checkpoints import Checkpoints

    before = signal.getsignal(signal.SIGTERM)
    original = Checkpoints.save

    def checkpoint(saver, *arguments, **options):
        saved = original(saver, *arguments, **options)
        if saver.saved_step == 32:
            os.kill(os.getpid(), signal.SIGTERM)
        return saved

    monkeypatch.setattr(Checkpoints, "save", checkpoint)
    with pytest.raises(Interrupted, match="interrupted at step 64; checkpoint saved"):
        train("Intrusive", TINY, envs=intrusive)
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.slow
def test_a_task_that_cannot_be_imported_any_more(plugin, resume):
    folder, run = plugin
    change(folder, "class Mine", "raise SystemExit(0)\nclass Mine")
    with pytest.raises(TaskError, match=r"task 'mine': import failed: SystemExit: 0 \(mine_plugin.py:3\)"):
        resume(run, force=True)
