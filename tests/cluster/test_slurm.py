"""Arrays of jobs on a fake SLURM: requeue, resume, retries, a restarted driver, and errors of SLURM."""

import concurrent.futures
import dataclasses
import re
import signal
import threading

import pytest

from rlctl.cluster.executors import choose_executor
from rlctl.errors import TaskError, UsageError
from rlctl.launching.seeds import train_seeds
from rlctl.launching.train import run_training as train_run
from rlctl.launching.trainings import Detached
from rlctl.runs.group import list_jobs, read_group, read_job
from rlctl.runs.train_request import TrainRequest
from tests.cluster import fake_slurm
from tests.cluster.conftest import wait_for
from tests.training.comparing import assert_same_run

LONG = {"total_timesteps": 6400}


@pytest.fixture
def train(request_of_line, slurm):
    def run(seeds, settings=None, **options):
        request = dataclasses.replace(request_of_line, settings={**request_of_line.settings, **(settings or {})})
        return train_seeds(request, seeds, episodes=2, make_trainings=choose_executor("slurm", **options))

    return run


@pytest.mark.slow
def test_a_preempted_job_is_requeued(toy, slurm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cluster.yaml").write_text("cpus: 1\nsbatch: [--time=1:00:00]\nsetup: [export SET_UP=1]\n")
    runs, lines = tmp_path / "runs", []
    runs.mkdir()
    trainings = choose_executor("slurm")(runs, toy.task, 1, None)
    request = TrainRequest(toy.task, settings={"seed": 3}, root=runs)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        codes = pool.submit(trainings.run, [lambda: trainings.train(request, lines.append)], "resume")
        wait_for(toy.read_pids)
        fake_slurm.preempt(slurm, "1_0", signal.SIGUSR1)
        wait_for(lambda: len(toy.read_pids()) == 2)
        toy.go()
        assert codes.result(60) == [2]  # there is no class Toy, which is no reason to retry
    job = read_job(runs, 3)
    assert (job.state, job.code, job.attempts, job.place) == ("ended", 2, 2, "slurm 1_0")
    assert "error: interrupted before the training began" in lines
    assert trainings.describe() == "on SLURM, 1 core each"
    assert "--time=1:00:00" in (slurm / "1.submitted").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1])
def test_a_preempted_job_is_requeued_and_its_run_is_equal_to_a_local_one(
    train, request_of_line, slurm, tmp_path, capsys, number
):
    (tmp_path / "cluster.yaml").write_text("cpus: 1\n")
    done = []
    thread = threading.Thread(target=lambda: done.append(train("3", LONG)))
    thread.start()
    wait_for(lambda: list(tmp_path.glob("runs/Line/*_seeds/*_s3/checkpoints/0*")))
    fake_slurm.preempt(slurm, "1_0", number)
    local = train_run(dataclasses.replace(request_of_line, settings={**request_of_line.settings, **LONG, "seed": 3}))
    thread.join(120)
    (result,) = done
    assert result.failed == {}
    job = read_job(result.score.group.path, 3)
    assert (job.state, job.code, job.attempts, job.place) == ("ended", 0, 2, "slurm 1_0")
    run = result.score.group.find_run(3)
    assert run.status()["resumed_at_step"] > 0
    assert_same_run(run, local.run)
    stderr = capsys.readouterr().err
    assert "1 seed, on SLURM, 1 core each" in stderr
    assert "seed 3: error: interrupted at step " in stderr


@pytest.mark.slow
def test_a_seed_is_given_up_after_retries_and_the_others_are_kept(train, slurm, tmp_path):
    (tmp_path / "cluster.yaml").write_text("retries: 0\n")
    done = []
    thread = threading.Thread(target=lambda: done.append(train("0-1", LONG)))
    thread.start()
    wait_for(lambda: list(tmp_path.glob("runs/Line/*_seeds/*_s0/checkpoints/0*")))
    fake_slurm.preempt(slurm, "1_0")
    thread.join(120)
    (result,) = done
    assert result.failed == {0: 143}
    assert result.score.group.is_done(1)


@pytest.mark.slow
def test_a_group_goes_on_without_its_driver_which_finds_it_again(train, slurm, tmp_path):
    with pytest.raises(Detached, match=r"submitted to SLURM; to follow the runs: rlctl train --resume \S+ --on slurm"):
        train("0", LONG, detach=True)
    (folder,) = tmp_path.glob("runs/Line/*_seeds")
    assert {job.state for job in list_jobs(folder)} <= {"queued", "running"}
    request = TrainRequest(resume=str(folder), root=tmp_path / "runs")
    result = train_seeds(request, None, episodes=2, make_trainings=choose_executor("slurm"))
    assert result.failed == {}
    assert len(list(slurm.glob("*.submitted"))) == 1
    assert read_group(folder).is_done(0)


@pytest.mark.slow
def test_a_folder_that_is_not_shared_is_named_and_not_tried_again(train, slurm, tmp_path, capsys):
    (tmp_path / "cluster.yaml").write_text(f"setup: ['rm {tmp_path}/runs/Line/*_seeds/.jobs/driver']\n")
    result = train("0")
    assert result.failed == {0: 5}
    assert "this node has a different folder there, or none" in capsys.readouterr().err
    assert read_job(result.score.group.path, 0).attempts == 1


@pytest.mark.slow
def test_a_full_disk_on_a_node_is_an_error_of_its_run(train, slurm, tmp_path, capsys):
    """As on a node with a full disk, no file can grow beyond a few kB."""
    (tmp_path / "cluster.yaml").write_text("setup: [ulimit -f 8]\n")
    result = train("0", LONG)
    assert result.failed == {0: 5}
    assert re.search(r"seed 0: error: \S+: File too large", capsys.readouterr().err)
    job = read_job(result.score.group.path, 0)
    assert job.attempts == 1
    (tmp_path / "cluster.yaml").write_text("cpus: 1\n")
    request = TrainRequest(resume=str(result.score.group.path), root=tmp_path / "runs")
    assert train_seeds(request, None, episodes=2, make_trainings=choose_executor("slurm")).failed == {}


@pytest.mark.slow
def test_a_driver_whose_slurm_is_gone_and_runs_whose_driver_is_gone(train, slurm, tmp_path, monkeypatch):
    (tmp_path / "cluster.yaml").write_text("lease_s: 2\n")
    monkeypatch.setattr("rlctl.cluster.slurm._ASK_QUEUE_S", 0.5)
    monkeypatch.setattr("rlctl.cluster.slurm._GONE_S", 3.0)
    failures = []

    def follow():
        with pytest.raises(TaskError) as caught:
            train("0", {"total_timesteps": 640_000})
        failures.append(str(caught.value))

    thread = threading.Thread(target=follow)
    thread.start()
    wait_for(lambda: list(tmp_path.glob("runs/Line/*_seeds/*_s0/checkpoints/0*")))
    (slurm / "bin" / "squeue").write_text(
        "#!/bin/sh\necho 'squeue: error: Unable to contact slurm controller' >&2; exit 1"
    )
    thread.join(60)
    assert failures == ["--on slurm: squeue failed: squeue: error: Unable to contact slurm controller"]
    (folder,) = tmp_path.glob("runs/Line/*_seeds")
    job = wait_for(lambda: (job := read_job(folder, 0)) and job.state == "ended" and job)
    assert (job.code, job.attempts) == (130, 1)
    assert "error: the driver has not answered for 2 s" in (folder / ".jobs" / "0.log").read_text()
    assert read_group(folder).find_run(0).status()["status"] == "interrupted"


def test_errors_of_slurm(train, slurm, tmp_path, monkeypatch):
    (tmp_path / "cluster.yaml").write_text("sbatch: [--refuse]\n")
    with pytest.raises(TaskError, match="--on slurm: sbatch failed: sbatch: error: Batch job submission failed"):
        train("0-1")
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(UsageError, match="squeue is not installed on this machine; use a login node"):
        train("0-1")
