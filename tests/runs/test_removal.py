import contextlib
import os
import pty
import select
import subprocess
import sys
from pathlib import Path

import pytest

from rlctl.errors import ArtifactError, UsageError
from rlctl.runs.listing import plan_prune, plan_removal, remove
from rlctl.runs.summary import summarize


def test_removes_what_is_named(write_run):
    gone, stays = write_run("reach/2026-01-01_00-00-00_s0"), write_run("reach/2026-01-01_00-00-01_s1")
    removal = plan_removal(["reach/2026-01-01_00-00-00_s0"])
    assert removal.bytes > 5000
    remove(removal)
    assert not gone.exists()
    assert stays.exists()
    assert list(gone.parent.iterdir()) == [stays]


def test_names_of_one_folder(write_run, monkeypatch):
    run = write_run("reach/2026-01-01_00-00-00_s0")
    removal = plan_removal(["reach/2026-01-01_00-00-00_s0", f"runs/reach/../reach/{run.name}", str(run)])
    assert removal.paths == [run]
    monkeypatch.chdir(run)
    assert summarize(Path()).name == f"reach/{run.name}"
    remove(plan_removal(["."]))
    assert not run.exists()


def test_keeps_the_best_of_each_task(write_run):
    best = write_run("reach/2026-01-01_00-00-00_s0", evals=((1, 0.9, 0.0),))
    second = write_run("reach/2026-01-01_00-00-01_s0", evals=((1, 0.8, 9.0),))
    third = write_run("reach/2026-01-01_00-00-02_s0", evals=((1, 0.7, 99.0),))
    other = write_run("ant/2026-01-01_00-00-00_s0", evals=((1, None, 1.0),))
    stopped = write_run("reach/2026-01-01_00-00-03_s0", "interrupted", evals=())
    remove(plan_removal([], keep_best=2))
    assert [path.exists() for path in (best, second, third, other, stopped)] == [True, True, False, True, True]


def test_keeping_the_best_leaves_groups_whole(write_run):
    seed = write_run("reach/2026-01-01_00-00-00_seeds/2026-01-01_00-00-00_s0")
    (seed.parent / "group.json").write_text("{}")
    alone = write_run("reach/2026-01-01_00-00-01_s0")
    assert [path.name for path in plan_removal([], keep_best=0).paths] == [alone.name]


def test_removes_a_run_whose_status_is_damaged(write_run):
    run = write_run("reach/2026-01-01_00-00-00_s0")
    (run / "run.json").write_text('{"status": "fini')
    assert plan_removal([str(run)]).paths == [run]


def test_never_removes_a_run_that_is_being_trained(write_run, hold_lock):
    run = write_run("reach/2026-01-01_00-00-00_s0", "running")
    hold_lock(run)
    with pytest.raises(UsageError, match="being trained"):
        plan_removal([str(run)])
    assert plan_removal([], keep_best=0).paths == []
    finished = write_run("reach/2026-01-01_00-00-01_s0")
    removal = plan_removal([str(finished)])
    hold_lock(finished)  # resumed between the question and the answer
    with pytest.raises(UsageError, match="being trained"):
        remove(removal)
    assert finished.exists()


def test_refuses_what_is_not_a_run(write_run, tmp_path):
    write_run("reach/2026-01-01_00-00-00_s0")
    (tmp_path / "thesis" / "chapters" / "one").mkdir(parents=True)
    for path in ("thesis", "thesis/chapters/one", "nothing", "runs", "runs/reach"):
        with pytest.raises(ArtifactError, match="not the folder of a run"):
            plan_removal([path])
    for nothing in ([], [""]):
        with pytest.raises(UsageError, match="give RUN"):
            plan_removal(nothing)


@pytest.mark.slow
def test_asks_only_on_a_terminal(write_run, rlctl):
    run = write_run("reach/2026-01-01_00-00-00_s0")
    refused = rlctl("runs", "rm", run, stdin=-3)
    assert refused.returncode == 2
    assert "--yes" in refused.stderr
    assert run.exists()
    closed = subprocess.run(
        ["sh", "-c", 'exec "$0" -m rlctl runs rm "$1" <&-', sys.executable, run], capture_output=True, text=True
    )
    assert (closed.returncode, closed.stderr) == (2, refused.stderr)
    done = rlctl("runs", "rm", run, "--yes")
    assert done.returncode == 0
    assert not run.exists()


@pytest.mark.slow
@pytest.mark.parametrize("answer", ["\x03", "\x04"], ids=["Ctrl-C", "Ctrl-D"])
def test_interrupted_at_the_question(write_run, answer):
    run = write_run("reach/2026-01-01_00-00-00_s0")
    process, terminal = pty.fork()
    if process == 0:
        os.execv(sys.executable, [sys.executable, "-m", "rlctl", "runs", "rm", str(run)])
    shown = os.read(terminal, 4096)
    while b"?" not in shown:
        shown += os.read(terminal, 4096)
    with contextlib.suppress(OSError):  # how Linux reports that the other end has closed
        while True:
            # Again while nothing happens: Python misses a Ctrl-C between its last look and the read that waits.
            os.write(terminal, answer.encode())
            while select.select([terminal], [], [], 10.0)[0] and (text := os.read(terminal, 4096)):
                shown += text
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 130
    assert b"Traceback" not in shown
    assert run.exists()


def test_prune_frees_checkpoints_of_finished_runs_only(write_run):
    done, stopped = write_run("reach/2026-01-01_00-00-00_s0"), write_run("reach/2026-01-01_00-00-01_s0", "interrupted")
    removal = plan_prune()
    assert removal.bytes == 5000
    remove(removal)
    assert not (done / "checkpoints").exists()
    assert (done / "run.json").exists()
    assert (stopped / "checkpoints").exists()


def test_checkpoints_behind_a_link_are_named_and_left(write_run, rlctl, tmp_path):
    run, elsewhere = write_run("reach/2026-01-01_00-00-00_s0"), tmp_path / "large-disk"
    (run / "checkpoints").rename(elsewhere)
    (run / "checkpoints").symlink_to(elsewhere)
    done = rlctl("runs", "prune", "--yes")
    assert (done.returncode, done.stdout) == (0, "nothing to remove\n")
    assert done.stderr.startswith("warning: runs/reach/2026-01-01_00-00-00_s0/checkpoints is a link and is not removed")
    assert str(elsewhere) in done.stderr
    assert list((run / "checkpoints").iterdir())


def test_only_what_is_named_is_pruned_and_a_dry_run_removes_nothing(write_run, rlctl):
    one, two = (write_run(f"{task}/2026-01-01_00-00-00_s0") for task in ("reach", "ant"))
    stopped = write_run("reach/2026-01-01_00-00-01_s0", "interrupted")
    done = rlctl("runs", "prune", "runs/ant/*", "--dry-run")
    assert done.stdout.splitlines() == ["runs/ant/2026-01-01_00-00-00_s0/checkpoints", "would remove 1 folder: 5.0 kB"]
    done = rlctl("runs", "rm", one, "--dry-run")
    assert (done.returncode, done.stdout.splitlines()[0]) == (0, str(one))
    assert rlctl("runs", "prune", "runs/ant/*", "--yes").returncode == 0
    assert [(run / "checkpoints").exists() for run in (one, two)] == [True, False]
    done = rlctl("runs", "prune", stopped, "--yes")
    assert done.returncode == 2
    assert "only the checkpoints of finished runs can be removed" in done.stderr
