"""What Python, PyBullet, MuJoCo and Gymnasium print in a command's own process."""

import os
import subprocess
import sys
import warnings

import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.library_output import redirect_stdout
from rlctl.printed_lines import collect


@pytest.fixture
def keep_warnings(monkeypatch):
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)


@pytest.mark.usefixtures("keep_warnings")
def test_own_output_of_a_command(capfd):
    with collect(), collect(), redirect_stdout():
        for _ in range(2):
            os.write(1, b"argv[0]=\nfrom a library\n")
            warnings.warn_explicit("\x1b[33mWARN: old\n id\x1b[0m", UserWarning, "/lib/site-packages/env.py", 3)
    os.write(1, b"result\n")
    out, err = capfd.readouterr()
    assert out == "result\n"
    shown = err.splitlines()
    assert sorted(shown[:2]) == ["env.py:3: UserWarning: WARN: old id", "from a library"]
    assert shown[2].startswith("(2 times each: ")
    assert len(shown) == 3


@pytest.mark.pybullet
def test_pybullet_is_imported_without_its_line():
    use = "import pybullet, sys; print(pybullet.DIRECT, file=sys.stderr)"
    code = (
        "from rlctl.library_output import redirect_stdout\nfrom rlctl.printed_lines import collect\n"
        f"with collect(), redirect_stdout():\n    {use}\n{use}"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "2\n2\n")


def test_without_a_command_nothing_is_redirected(capfd):
    with redirect_stdout():
        os.write(1, b"argv[0]=\n")
    assert capfd.readouterr() == ("argv[0]=\n", "")


def test_warnings_of_mujoco_leave_no_file(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    EnvSpec("HalfCheetah-v5").make().close()  # its model has a deprecated attribute
    assert "MuJoCo warning: compiler attribute 'settotalmass' is deprecated" in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []
