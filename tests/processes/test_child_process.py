"""Child processes: what they are given, what they print, how they end, and that nothing is left of them."""

import os
import signal
import subprocess
import sys
import time

import pytest

from rlctl.printed_lines import LineReader
from rlctl.processes.child_process import ChildEndedError, ChildProcess, Standstill

ANSWER = "tests.processes.answering:answer"


@pytest.fixture
def started():
    """Starts children, and returns the lines that they print."""
    children, lines = [], []

    def start(hash_seed="0", **arguments):
        reader = LineReader(lines.append)
        child = ChildProcess(
            ANSWER,
            arguments,
            stdout=reader.descriptor,
            stderr=reader.descriptor,
            env={"PYTHONHASHSEED": hash_seed},
        )
        reader.close_descriptor()
        children.append(child)
        return child, reader, lines

    yield start
    for child in children:
        child.close()


def is_alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until_dead(pid):
    deadline = time.monotonic() + 60
    while is_alive(pid) and time.monotonic() < deadline:
        time.sleep(0.02)
    return not is_alive(pid)


def test_a_child_gets_its_arguments_and_its_lines_are_read(started):
    child, reader, lines = started(hash_seed="7", number=3)
    assert child.receive() == {"number": 3, "threads": "1", "hash": "7"}
    child.send("go on")
    assert child.describe_end() == "ended with exit code 0"
    reader.wait()
    assert sorted(lines) == ["err", "out"]


def test_how_a_child_ended_is_reported(started):
    child, *_ = started(exits=9)
    child.receive()  # a loaded machine may take longer to start it than the end is waited for
    assert child.describe_end() == "ended with exit code 9"
    child, *_ = started()
    child.receive()
    os.kill(child.process.pid, signal.SIGABRT)
    assert child.describe_end() == "was killed by SIGABRT"


@pytest.mark.slow_except("options0")
@pytest.mark.parametrize("options", [{"stdin": None}, {"start_new_session": True}])
def test_closing_kills_what_the_child_has_started(started, options):
    child, *_ = started(starts=options)
    child.receive()
    grandchild = child.receive()
    child.close()
    child.close()
    assert child.process.poll() == -signal.SIGKILL
    assert wait_until_dead(grandchild)


def test_closing_kills_what_is_left_of_a_child_that_has_ended(started):
    child, *_ = started(starts={"start_new_session": True})
    child.receive()
    left = child.receive()
    child.send("go on")
    child.process.wait(timeout=60)
    assert is_alive(left)
    child.close()
    assert wait_until_dead(left)


def test_a_child_ends_with_its_parent():
    script = (
        f"from rlctl.processes.child_process import ChildProcess; import os, sys; "
        f"child = ChildProcess('{ANSWER}', {{}}, stdout=2, stderr=2); child.receive(); "
        f"print(child.process.pid, flush=True); os._exit(0)"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=250, check=True)
    assert wait_until_dead(int(run.stdout))


def test_a_child_does_not_end_by_ctrl_c(started):
    child, *_ = started()
    child.receive()
    os.kill(child.process.pid, signal.SIGINT)
    child.send("go on")
    assert child.describe_end() == "ended with exit code 0"


def test_what_an_environment_writes_to_the_connection_is_no_message(started):
    child, *_ = started(prints=True)
    child.receive()
    with pytest.raises(ChildEndedError, match="wrote invalid data to its connection: not a message of rlctl"):
        child.receive()


def test_a_child_that_ended_neither_receives_nor_answers(started):
    child, *_ = started(exits=9)
    child.receive()
    with pytest.raises(ChildEndedError, match="ended with exit code 9"):
        child.receive()
    with pytest.raises(ChildEndedError, match="ended with exit code 9"):
        child.send("go on")


def test_a_standstill_ends_with_every_change():
    progress, clock = iter([0, 0, 1, 1]), iter([10.0, 12.5, 13.0, 20.0])
    standstill = Standstill(lambda: next(progress), lambda: next(clock))
    assert [standstill.seconds() for _ in range(3)] == [2.5, 0.0, 7.0]
