"""Streams that are closed or not UTF-8, and memory that is refused."""

import os
import subprocess
import sys

import pytest

from rlctl import output
from rlctl.errors import UsageError
from rlctl.processes import error_boundary

RLCTL = f"{sys.executable} -m rlctl"


def shell(command, **environment):
    return subprocess.run(
        ["bash", "-c", command], env={**os.environ, **environment}, capture_output=True, timeout=250, check=False
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "encoding", ["ascii:strict", *(pytest.param(name, marks=pytest.mark.slow) for name in ("ascii", "latin-1:strict"))]
)
def test_a_terminal_that_is_not_utf8(encoding):
    commands = [["--help"], ["tasks"], ["eval", "nothing_of_the_name_é"]]
    code = f"import sys; from rlctl.cli import run; print([run(each) for each in {commands!r}], file=sys.stderr)"
    done = shell(f'{sys.executable} -c "{code}"', PYTHONIOENCODING=encoding, PYTHONUTF8="0")
    assert done.stderr.endswith(b"[0, 0, 5]\n"), done.stderr
    assert b"Traceback" not in done.stderr


def test_a_message_of_any_length_is_short(capsys):
    assert error_boundary.run(_raise_long_error) == 2
    assert len(capsys.readouterr().err) < 1600


def _raise_long_error():
    raise UsageError(f"seed {10**4000}")


def test_what_others_named_is_printed_as_it_is(capsys):
    output.err().print("arms.py:Robot: no joint [left]")
    assert capsys.readouterr().err == "arms.py:Robot: no joint [left]\n"


def test_progress_in_ascii(monkeypatch, capsys):
    from rlctl.training.display import sparkline

    assert sparkline([0.0, 0.5, 1.0]) == "▁▅█"
    monkeypatch.setattr("rlctl.output.is_utf8", lambda: False)
    assert sparkline([0.0, 0.5, 1.0]).isascii()


@pytest.mark.slow
def test_stderr_is_closed(tmp_path):
    done = shell(f"cd {tmp_path}; {RLCTL} eval 2>&-; echo $?")
    assert done.stdout == b"5\n"
    done = shell(f"cd {tmp_path}; {RLCTL} tasks show reach 2>&-; echo $?")
    assert done.stdout.endswith(b"\n0\n")


INTERRUPTED = """
import os, signal, sys, threading, time
from rlctl.cli import run

def interrupt():
    while "rlctl.evaluation.evaluate" not in sys.modules:  # the command has begun
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGINT)

threading.Thread(target=interrupt).start()
sys.exit(run(["eval", "reach", "--pretrained", "--episodes", "100000"]))
"""


def test_an_interruption_is_said():
    done = shell(f"{sys.executable} -c '{INTERRUPTED}'")
    assert done.returncode == 130
    assert done.stderr == b"interrupted\n"


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        OSError(12, "Cannot allocate memory"),
        ImportError("libtorch_cpu.so: failed to map segment from shared object"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:119] DefaultCPUAllocator: can't allocate memory: you tried"),
    ],
)
def test_memory_that_is_refused(error, capsys):
    assert error_boundary.report_unexpected(error) == 5
    assert capsys.readouterr().err.startswith("error: not enough memory")


FILES_OF_ONE_KB = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (1024, 1024))
from pathlib import Path
from rlctl.processes import error_boundary
from rlctl.processes.child_process import anonymous_file, grow_anonymous_file
from rlctl.storage import files
sys.exit(error_boundary.run(lambda: {call}))
"""


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize(
    ("call", "name"),
    [
        ("files.write_bytes(Path('policy.bin'), bytes(4096))", "policy.bin"),
        ("files.append(Path('table.csv'), bytes(4096), 0)", "table.csv"),
        ("grow_anonymous_file(anonymous_file(), 4096)", "memory of 4,096 bytes that processes share"),
    ],
)
def test_a_file_that_may_not_be_so_large_is_named(call, name, tmp_path):
    script = FILES_OF_ONE_KB.format(call=call)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path, check=False)
    limit = "files of this process may have 1,024 bytes; raise that limit: ulimit -f unlimited"
    assert (done.returncode, done.stderr) == (5, f"error: {name}: File too large\n{limit}\n")
