"""The run folder: finding runs and policies, and keeping a second writer out."""

import errno
import fcntl
import json
import os
import re
import subprocess
import sys

import pytest

from rlctl.errors import ArtifactError, RunTaken, UsageError
from rlctl.recipe.recipe import Recipe
from rlctl.runs import directory


def error(kind, call, *arguments):
    with pytest.raises(kind) as caught:
        call(*arguments)
    return str(caught.value)


def test_a_recipe_that_was_deleted(make_run):
    run = make_run("reach", "2026-01-01_00-00-00_s0")
    with pytest.raises(ArtifactError, match=r"recipe.yaml: no such file; a run needs the recipe that"):
        run.recipe()


def test_a_recipe_that_was_edited_is_refused(make_run):
    run = make_run("reach", "2026-01-01_00-00-00_s0")
    run.write_recipe(Recipe(algo="ppo", total_timesteps=100, n_envs=4, seed=3))
    assert run.recipe().seed == 3
    run.recipe_file.write_text(run.recipe_file.read_text().replace("seed: 3", "seed: 4"))
    with pytest.raises(ArtifactError, match=r"recipe.yaml: changed since the training wrote it. To train with"):
        run.recipe()


def test_a_new_run(root):
    run = directory.create("path/to/my_env.py:MyEnv", 3, root)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d_s3", run.path.name)
    assert run.path.parent == root / "MyEnv"
    assert os.readlink(root / "latest") == f"MyEnv/{run.path.name}"
    others = [directory.create("path/to/my_env.py:MyEnv", 3, root) for _ in range(3)]
    assert len({run.path, *(other.path for other in others)}) == 4
    assert (root / "latest").resolve() == others[-1].path
    assert sorted(os.listdir(root)) == ["MyEnv", "latest"]


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "runs").write_text("a file")
    assert error(ArtifactError, directory.create, "reach", 0, tmp_path / "runs").endswith(
        "runs/reach: cannot make a folder for runs: Not a directory"
    )


def test_half_written_checkpoints_do_not_count(root, make_run):
    run = make_run("reach", "2026-01-01_10-00-00_s0")
    for name in ("000000200", ".000000300.77.part", "000000100"):
        (run.path / "checkpoints" / name).mkdir(parents=True)
    assert [folder.name for folder in run.checkpoints()] == ["000000100", "000000200"]


def test_status(root, make_run):
    run = make_run("reach", "2026-01-01_10-00-00_s0")
    run.write_status({"status": "running", "steps": 0})
    run.write_status({"steps": 10})
    assert run.status() == {"task": "reach", "status": "running", "steps": 10}
    run.status_file.write_text("[]")
    assert error(ArtifactError, run.status) == f"{run.status_file}: not a run of rlctl: it has no task"
    run.status_file.write_text("{")
    assert error(ArtifactError, run.status).startswith(f"{run.status_file}: damaged: ")


def test_a_second_writer_is_refused(root, make_run):
    run = make_run("reach", "2026-01-01_10-00-00_s0")
    lock = run.lock()
    message = error(UsageError, run.lock)
    assert message == f"{run.path}: another process is writing this run (pid {os.getpid()} on {os.uname().nodename})"
    lock.release()
    run.lock().release()


def test_a_file_system_without_locks_keeps_nobody_out(monkeypatch, root, make_run):
    run = make_run("reach", "2026-01-01_10-00-00_s0")

    def flock(*_):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    assert run.lock().keeps_out
    monkeypatch.setattr(fcntl, "flock", flock)
    with run.lock() as lock, run.lock():
        assert not lock.keeps_out


def test_a_lock_ends_with_its_process(root, make_run):
    run = make_run("reach", "2026-01-01_10-00-00_s0")
    code = (
        "import sys, time; from pathlib import Path; from rlctl.runs.directory import RunDirectory\n"
        f"lock = RunDirectory(Path({json.dumps(str(run.path))})).lock(); print('locked', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"locked\n"
        assert f"(pid {writer.pid} on " in error(UsageError, run.lock)
        writer.kill()
    run.lock().release()


def test_the_last_process_to_claim_a_run_has_it_where_locks_keep_nobody_out(monkeypatch, root, make_run):
    def flock(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", flock)
    first = make_run("reach", "2026-01-01_10-00-00_s0")
    second = directory.RunDirectory(first.path)
    first.lock()
    first.write_status({"steps": 1})
    second.lock()
    message = error(RunTaken, lambda: first.write_status({"steps": 2}))
    assert message == f"{first.path}: another process has taken over this run; this process no longer writes to it"
    second.write_status({"steps": 3})
    assert first.status()["steps"] == 3
