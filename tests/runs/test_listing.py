import contextlib
import json
import os
import pty
import re
import subprocess
import sys
import time

import pytest

from rlctl.errors import ArtifactError
from rlctl.runs.directory import RunDirectory
from rlctl.runs.group import JOBS, Job, write_job
from rlctl.runs.listing import format_changes, list_runs
from rlctl.runs.summary import summarize


def test_states(write_run, hold_lock):
    done = write_run("reach/2026-01-01_00-00-00_s0")
    running = write_run("reach/2026-01-01_00-00-01_s0", "running")
    hold_lock(running)
    killed = write_run("reach/2026-01-01_00-00-02_s0", "running")
    stopped = write_run("reach/2026-01-01_00-00-03_s0", "interrupted")
    (stopped / "checkpoints" / "000001024").mkdir()
    failed = write_run("reach/2026-01-01_00-00-04_s0", "failed", error="task 'reach': it broke\nat step 3")
    texts = [summarize(path).state_text for path in (done, running, killed, stopped, failed)]
    assert texts[:2] == ["done", "running"]
    assert texts[2:] == ["stopped at step 1,000", "stopped at step 1,024", "failed: task 'reach': it broke"]


def test_runs_that_a_cluster_executes(tmp_path):
    group = tmp_path / "runs/reach/2026-01-01_00-00-00_seeds"
    (group / JOBS).mkdir(parents=True)
    (group / "group.json").write_text("{}")
    run = RunDirectory(group / "2026-01-01_00-00-01_s0")
    run.path.mkdir()
    run.write_status({"task": "reach", "seed": 0, "status": "running"})
    write_job(group, Job(0, "reach", "running", "slurm 12_0", "node7", 2))
    write_job(group, Job(1, "reach", "queued", "slurm 12_1"))
    texts = {run.seed: run.state_text for run in list_runs(root=tmp_path / "runs", waiting=True)}
    assert texts == {0: "running: on node7 as slurm 12_0, attempt 2", 1: "queued: as slurm 12_1"}
    assert [run.seed for run in list_runs(root=tmp_path / "runs")] == [0]
    write_job(group, Job(0, "reach", "ended", "slurm 12_0", "node7", 2, 0))
    assert summarize(run.path).state == "stopped"


def test_best_is_by_success_then_return(write_run):
    evals = ((10, 0.5, 9.0), (20, 0.7, 1.0), (30, 0.7, 2.0), (40, 0.1, 50.0))
    run = write_run("reach/2026-01-01_00-00-00_s0", evals=evals)
    summary = summarize(run)
    assert (summary.best_step, summary.best_success, summary.best_return) == (30, 0.7, 2.0)
    without = summarize(write_run("ant/2026-01-01_00-00-00_s0", evals=((10, None, 9.0), (20, None, 4.0))))
    assert (without.best_step, without.best_success, without.best_return) == (10, None, 9.0)


def test_half_a_row_is_no_row(write_run):
    run = write_run("reach/2026-01-01_00-00-00_s0", "running", evals=())
    with (run / "metrics.csv").open("a") as file:
        file.write("99999,1.0")
    with (run / "evals.csv").open("a") as file:
        file.write("2000,20.0,100")
    summary = summarize(run)
    assert summary.steps == 1000
    assert summary.best_return is None


def test_damaged_folders_are_listed_as_such(write_run, tmp_path):
    write_run("reach/2026-01-01_00-00-00_s0")
    (tmp_path / "runs/reach/empty").mkdir()
    broken = write_run("reach/2026-01-01_00-00-05_s0")
    (broken / "run.json").write_text('{"status": "fin')
    odd = write_run("reach/2026-01-01_00-00-06_s0")
    (odd / "metrics.csv").write_bytes(b"steps\n\xff\x00\n")
    states = {run.path.name: run.state for run in list_runs()}
    assert states["empty"] == "damaged"
    assert states[broken.name] == "damaged"
    assert states[odd.name] == "damaged"
    assert sorted(states.values()).count("done") == 1


def test_order_and_selection(write_run):
    write_run("reach/2026-01-01_00-00-00_s0", evals=((10, 0.9, 1.0),), started="2026-01-01T00:00:00+00:00")
    write_run("ant/2026-01-02_00-00-00_s0", evals=((10, 0.1, 1.0),), started="2026-01-02T00:00:00+00:00")
    assert [run.task for run in list_runs()] == ["ant", "reach"]
    assert [run.task for run in list_runs(sort="score")] == ["reach", "ant"]
    assert [run.task for run in list_runs("reach")] == ["reach"]
    with pytest.raises(ArtifactError, match=r"no run of 'reech'.*Did you mean 'reach'"):
        list_runs("reech")
    with pytest.raises(ArtifactError, match=r"rlctl runs has no such command\. Did you mean 'show'"):
        list_runs("shwo", commands=["list", "show", "compare"])


def test_no_runs_yet(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert list_runs() == []


def test_changes_are_cut_short():
    assert format_changes({}) == ""
    assert format_changes({"a": 1, "b": 2}) == "a=1 b=2"
    assert format_changes(dict.fromkeys("abcdef", 0)) == "a=0 b=0 c=0 d=0 and 2 more"


def test_command_lists_as_text_and_json(write_run, rlctl):
    write_run("reach/2026-01-01_00-00-00_s0", recipe_changes={"algo_kwargs.gamma": 0.9})
    text = rlctl("runs")
    assert text.returncode == 0
    assert "reach/2026-01-01_00-00-00_s0" in text.stdout
    assert "gamma=0.9" in text.stdout
    (run,) = json.loads(rlctl("runs", "--json", "-").stdout)["runs"]
    assert (run["state"], run["best_success"], run["changes"]) == ("done", 0.5, {"algo_kwargs.gamma": 0.9})


@pytest.mark.slow
def test_a_thousand_runs_are_listed_quickly(write_run):
    for number in range(1000):
        write_run(f"reach/2026-01-01_00-00-00_s{number}")
    list_runs()
    begun = time.process_time()
    assert len(list_runs()) == 1000
    assert time.process_time() - begun < 5  # 0.1 on an idle machine


def on_terminal(*arguments, columns):
    """Return what a command shows on a terminal of so many columns."""
    leader, follower = pty.openpty()
    env = {**os.environ, "COLUMNS": str(columns), "NO_COLOR": "1", "TERM": "xterm"}
    command = [sys.executable, "-m", "rlctl", *arguments]
    done = subprocess.Popen(command, stdout=follower, stderr=subprocess.PIPE, env=env)
    os.close(follower)
    shown = b""
    with contextlib.suppress(OSError):  # how Linux reports that the other end has closed
        while part := os.read(leader, 4096):
            shown += part
    done.communicate()
    os.close(leader)
    return re.sub(r"\x1b\[[0-9;]*m", "", shown.decode()).replace("\r\n", "\n")


@pytest.mark.slow
def test_a_narrow_terminal_has_fewer_columns_and_no_broken_names(write_run):
    name = "half-cheetah/2026-01-01_00-00-00_s0"
    changes = {"algo_kwargs.gamma": 0.9, "total_timesteps": 1000}
    run = write_run(name, recipe_changes=changes, evals=((123_456, 0.25, 1234.5),), steps=123_456)
    terms = [f"term/quantity_{number}" for number in range(9)]
    (run / "evals.csv").write_text(
        f"steps,episodes,success,return,{','.join(terms)}\n123456,100,0.25,1234.5,{','.join(['0.123456'] * 9)}\n"
    )
    shown = on_terminal("runs", columns=80)
    assert max(map(len, shown.splitlines())) <= 80
    (line,) = [line for line in shown.splitlines() if name in line]
    assert line.split() == [name, "done", "25.0%", "gamma=0.9"]
    assert "total_timesteps=1000" in shown  # folded
    assert f"{name}  ppo" in on_terminal("runs", columns=160)
    table = on_terminal("runs", "show", name.replace("half", "runs/half"), columns=80).splitlines()
    header = next(index for index, line in enumerate(table) if line.startswith("  steps"))
    assert len(table[header]) <= 80
    assert table[header + 1].split()[:4] == ["123,456", "100", "25.0%", "1234"]
