"""`rlctl play` as a process: its address, the end by a signal with a recording, and a run that does not exist."""

import os
import signal
import subprocess
import sys

import pytest

from tests.robot.play.pages import Page


@pytest.mark.slow
def test_a_recording_that_a_signal_ends(tmp_path):
    command = [sys.executable, "-m", "rlctl", "play", "walk", "--pretrained", "--port", "0", "--record", "-o", "films"]
    environment = {**os.environ, "NO_COLOR": "1"}
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )
    while not (line := process.stderr.readline()).startswith("open http://127.0.0.1:"):
        assert line, "it ended"
    page = Page(line.split()[1])
    page.wait_for(lambda frame: frame["recording"] and frame["time"] > 0.2)
    page.close()
    process.send_signal(signal.SIGINT)
    printed, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    assert printed.splitlines()[0].startswith("walk: 1 episode, ")
    assert printed.splitlines()[1] == "recording films/000000.rrd"
    assert sorted(file.name for file in (tmp_path / "films").iterdir()) == ["000000.npz", "000000.rrd"]
    shown = subprocess.run(
        [*command[:3], "replay", "films/000000.npz"], cwd=tmp_path, capture_output=True, text=True, env=environment
    )
    assert shown.returncode == 2
    assert shown.stderr.startswith("error: films/000000.npz: a person steered this episode, so its seed and actions")


def test_a_run_that_does_not_exist(rlctl):
    done = rlctl("play", "reech")
    assert done.returncode == 5
    assert done.stderr.startswith("error: no run 'reech': ")
