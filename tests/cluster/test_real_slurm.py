"""Arrays on a real SLURM of this machine: requeue, preemption, stop. Skipped where SLURM is not installed."""

import dataclasses
import json
import signal
import subprocess
import threading

import pytest

from rlctl.cluster.executors import choose_executor
from rlctl.launching.seeds import train_seeds
from rlctl.launching.train import run_training
from rlctl.runs.group import read_job
from tests.cluster import real_slurm
from tests.cluster.conftest import wait_for
from tests.cluster.driver import STOPS, Driver, assert_it_resumes, has_ended
from tests.training.comparing import assert_same_run

LONG = {"total_timesteps": 12_800}
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(real_slurm.find_missing()), reason=f"not installed: {real_slurm.find_missing()}"),
]


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    with real_slurm.running_slurm(tmp_path_factory.mktemp("slurm")):
        yield


@pytest.fixture
def begin(request_of_line, slurm, tmp_path):
    """Train seeds on SLURM in a thread; the function returned waits for the result."""
    (tmp_path / "cluster.yaml").write_text("cpus: 1\n")

    def start(seeds):
        request = dataclasses.replace(request_of_line, settings={**request_of_line.settings, **LONG})
        results = []
        executor = choose_executor("slurm")
        thread = threading.Thread(
            target=lambda: results.append(train_seeds(request, seeds, episodes=2, make_trainings=executor))
        )
        thread.start()

        def finish():
            thread.join(240)
            (result,) = results
            return result

        return finish

    return start


def run(*command):
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def wait_for_checkpoint(tmp_path, seed):
    wait_for(lambda: list(tmp_path.glob(f"runs/Line/*_seeds/*_s{seed}/checkpoints/0*")), 120)


@pytest.mark.parametrize("how", ["requeue", "preemption"])
def test_a_job_that_loses_its_node_resumes_to_the_same_bit(begin, request_of_line, tmp_path, how):
    finish = begin("3")
    wait_for_checkpoint(tmp_path, 3)
    if how == "requeue":
        number = wait_for(lambda: run("squeue", "-h", "-r", "-o", "%i", "-t", "RUNNING"))
        run("scontrol", "requeue", number)
    else:  # a job of a higher partition takes all cores
        run("sbatch", "--partition=high", "--exclusive", "--wrap=sleep 3", "--output=/dev/null")
    result = finish()
    assert result.failed == {}
    group = result.score.group
    assert read_job(group.path, 3).attempts == 2
    remote = group.find_run(3)
    assert remote.status()["resumed_at_step"] > 0
    local = run_training(dataclasses.replace(request_of_line, settings={**request_of_line.settings, **LONG, "seed": 3}))
    assert_same_run(remote, local.run)
    assert run("squeue", "-h") == ""


@pytest.mark.parametrize(("number", "code"), STOPS)
def test_a_driver_that_ends(slurm, installed_rlctl, tmp_path, number, code):
    (tmp_path / "cluster.yaml").write_text("cpus: 1\nlease_s: 4\n")
    driver = Driver(tmp_path, "--on", "slurm", steps=60_000)  # still training when the lease has ended
    run_folder, pid = driver.wait_for_checkpoint()
    ended, printed = driver.end(number)
    assert ended == code
    wait_for(lambda: has_ended(pid), 60)
    wait_for(lambda: run("squeue", "-h") == "")
    assert json.loads((run_folder / "run.json").read_text())["status"] == "interrupted"
    if number == signal.SIGINT:
        group = run_folder.parent.relative_to(tmp_path)
        assert printed.strip().endswith(f"resume with: rlctl train --resume {group} --on slurm")
    else:
        log = (run_folder.parent / ".jobs" / "3.log").read_text()
        assert "error: the driver has not answered for 4 s; --detach submits runs that need none" in log
    assert_it_resumes(installed_rlctl, run_folder, "slurm")


def test_a_detached_group_needs_no_driver(slurm, installed_rlctl, tmp_path):
    (tmp_path / "cluster.yaml").write_text("cpus: 1\nlease_s: 1\n")
    driver = Driver(tmp_path, "--on", "slurm", "--detach", steps=6400)
    code, printed = driver.end()
    assert code == 0
    assert "submitted to SLURM; to follow the runs: rlctl train --resume runs/" in printed
    assert "_seeds" in installed_rlctl("runs").stdout
    wait_for(lambda: run("squeue", "-h") == "", 150)
    (group,) = tmp_path.glob("runs/*/*_seeds")
    done = installed_rlctl("train", "--resume", group, "--on", "slurm")
    assert done.returncode == 0, done.stderr
    assert "1 seed, all done: nothing to train" in done.stderr
