"""Signals that ask a training to stop, in each of its phases: sent to it alone, to all its processes, and twice."""

import contextlib
import json
import os
import pty
import signal
import subprocess
import sys
import time

import psutil
import pytest

from tests.crash.contract import assert_nothing_lost, assert_quiet
from tests.crash.phases import PHASES, first_of_two
from tests.crash.trials import ARGUMENTS, end_orphans, members, only_run

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}
BEFORE = ("workers start", "workers build", "run folder")
AFTER = ("last checkpoint", "done")
CASES = [(phase, number) for phase in PHASES for number in CODES]


@pytest.mark.crash  # a quick one is in tests/training/test_interruption.py
@pytest.mark.parametrize(("phase", "number"), CASES)
@pytest.mark.parametrize("everybody", [pytest.param(False, id="alone"), pytest.param(True, id="everybody")])
def test_a_signal_in_a_phase(trials, whole, tmp_path, phase, number, everybody):
    before = whole("ppo")
    ended = trials.run(
        ARGUMENTS["ppo"],
        tmp_path,
        real_workers=everybody,
        signal={"number": int(number), "phase": phase, "everybody": everybody},
    )
    assert_quiet(ended)
    if phase in AFTER:
        assert ended.code == 0, ended.stderr
    else:
        assert ended.code == CODES[number], ended.stderr
        assert "interrupted" in ended.stderr.splitlines()[-1]
        if phase not in BEFORE:
            assert "checkpoint saved. Resume with: rlctl train --resume runs/Line/" in ended.stderr
            assert ended.announced > 0
    assert_nothing_lost(trials, ARGUMENTS["ppo"], ended, only_run(before.folder))


@pytest.mark.crash
@pytest.mark.parametrize(("phase", "number"), CASES)
def test_a_second_signal_ends_it_at_once(trials, whole, tmp_path, phase, number):
    ended = trials.run(
        ARGUMENTS["ppo"],
        tmp_path,
        signal={"number": int(number), "phase": phase, "again": True},
    )
    assert_quiet(ended)
    if phase in BEFORE:  # the first one ends it already, and the second may come while it ends
        assert ended.code in (CODES[number], CODES[first_of_two(number)]), ended.stderr
    else:
        assert ended.code == (0 if phase == "done" else CODES[number]), ended.stderr
    assert_nothing_lost(trials, ARGUMENTS["ppo"], ended, only_run(whole("ppo").folder))


START = 12  # moments, evenly over the first seconds of a process


@pytest.mark.crash
@pytest.mark.parametrize("part", range(START))
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_the_process_starts(tmp_path, number, part):
    moment = 0.15 + 0.4 * (part + list(CODES).index(number) / 3)
    process = subprocess.Popen(
        [sys.executable, "-m", "rlctl", *ARGUMENTS["ppo"], "-n", "100_000"],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    time.sleep(moment)
    stderr = None
    while stderr is None:  # while Python itself starts it may swallow an interrupt: then one is sent again
        for each in members(process.pid):
            with contextlib.suppress(psutil.NoSuchProcess):  # the first one that is asked may take the others along
                each.send_signal(number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            _, stderr = process.communicate(timeout=10)
    # Until rlctl's first line runs, Python itself decides.
    assert process.returncode in (CODES[number], -number), stderr
    if process.returncode == CODES[number]:
        assert "Traceback" not in stderr
    assert end_orphans(process.pid) == []


@pytest.mark.crash
def test_a_closed_terminal(tmp_path):
    process, terminal = pty.fork()
    if process == 0:
        os.chdir(tmp_path)
        command = [sys.executable, "-m", "rlctl", *ARGUMENTS["ppo"], "-n", "1_000_000"]
        os.execv(command[0], command)
    deadline = time.monotonic() + 250.0
    while not list(tmp_path.glob("runs/Line/*/metrics.csv")):
        assert time.monotonic() < deadline
        os.read(terminal, 2**16)
    os.close(terminal)
    _, status = os.waitpid(process, 0)
    assert os.waitstatus_to_exitcode(status) == CODES[signal.SIGHUP]
    assert end_orphans(process) == []
    content = json.loads((only_run(tmp_path).status_file).read_text())
    assert content["status"] == "interrupted"
    assert "checkpoint saved" in content["error"]
