"""A driver in a process of its own, which a test can stop or kill."""

import json
import os
import signal
import subprocess
import sys

import psutil

from tests.cluster.conftest import LINE, wait_for

OPTIONS = ["--no-check", "--set", "n_envs=2", "--set", "algo_kwargs.n_steps=32", "--set", "algo_kwargs.batch_size=32"]


class Driver:
    """`rlctl train --seeds 3` in a folder."""

    def __init__(self, folder, *arguments, task=LINE, steps=12_800):
        command = ["train", task, "--seeds", "3", "-n", str(steps), *OPTIONS, *arguments]
        self.folder = folder
        self.process = subprocess.Popen(
            [sys.executable, "-m", "rlctl", *command], cwd=folder, stderr=subprocess.PIPE, text=True
        )

    def wait_for_checkpoint(self):
        """Return the run's folder and its process, once it has saved a checkpoint."""

        def find_checkpoints():
            checkpoints = self.folder.glob("runs/*/*_seeds/*_s3/checkpoints/0*")
            return [folder for folder in checkpoints if folder.name.isdecimal() and int(folder.name)]

        run = wait_for(find_checkpoints, 150)[0].parents[1]
        return run, json.loads((run / "run.json").read_text())["pid"]

    def end(self, number=0):
        """Send a signal, wait for the driver's end and return its exit code and what it printed."""
        if number:
            os.kill(self.process.pid, number)
        _, printed = self.process.communicate(timeout=200)
        return self.process.returncode, printed


def has_ended(pid):
    """Return whether a process no longer runs."""
    return not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


def assert_it_resumes(installed_rlctl, run, on):
    """Resume the group of a run and check that the run was finished from a checkpoint."""
    done = installed_rlctl("train", "--resume", run.parent, "--on", on, timeout=240)
    assert done.returncode == 0, done.stderr
    status = json.loads((run / "run.json").read_text())
    assert status["status"] == "finished"
    assert status["resumed_at_step"] > 0


STOPS = [(signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)]
"""A signal for the driver and its exit code."""
