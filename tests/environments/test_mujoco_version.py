"""Errors of code that was written for another MuJoCo."""

import importlib
import sys

import pytest

from rlctl.environments.mujoco_version import PROVEN_OLDER, mujoco_fix

mujoco = pytest.importorskip("mujoco")
TRY = f"pip install mujoco=={PROVEN_OLDER}"
METADATA = "Metadata-Version: 2.1\nName: old-robots\nVersion: 1.3\nRequires-Dist: mujoco<3.9,>=2.2\n"


@pytest.fixture
def raise_in(tmp_path, monkeypatch):
    """Raises an error in a module of an installed package, or in a file of the user."""

    def raise_there(line, *, installed):
        folder = tmp_path / "site-packages" if installed else tmp_path
        package, info = folder / "old_robots", folder / "old_robots-1.3.dist-info"
        for made in (package, info):
            made.mkdir(parents=True)
        (package / "__init__.py").write_text(f"import mujoco\ndef fail():\n    {line}\n")
        (info / "METADATA").write_text(METADATA)
        (info / "RECORD").write_text("old_robots/__init__.py,,\n")
        monkeypatch.syspath_prepend(folder)
        monkeypatch.delitem(sys.modules, "old_robots", raising=False)
        with pytest.raises((AttributeError, AssertionError, KeyError, RuntimeError, ValueError)) as caught:
            importlib.import_module("old_robots").fail()
        return mujoco_fix(caught.value)

    return raise_there


@pytest.mark.slow
def test_of_an_installed_package_both_versions_are_named(raise_in, monkeypatch):
    version = mujoco.__version__
    expected = f"old-robots 1.3 (it asks for mujoco<3.9,>=2.2) may be written for another MuJoCo than {version}: "
    fix = raise_in("mujoco.mj_no_such_function()", installed=True)
    assert fix.startswith(expected)
    assert fix.removeprefix(expected) in (TRY, "pip install --upgrade mujoco")


def test_of_the_users_file_only_what_another_version_causes(raise_in):
    fix = raise_in("assert mujoco.mjtJoint.mjJNT_HINGE in ()", installed=False)
    assert fix.startswith(f"MuJoCo {mujoco.__version__} is installed. If this was written for another version: ")


OTHER = [
    "raise RuntimeError('no licence')",
    "{}['arm']",
    "raise ValueError('mujoco: no')",
    "mujoco.MjModel.from_xml_path('arm.xml'.as_posix())",  # for which no version of MuJoCo is to blame
]


@pytest.mark.parametrize("line", OTHER)
def test_other_errors_of_the_users_file_get_no_advice(line, raise_in):
    assert raise_in(line, installed=False) == ""


def test_other_errors_of_a_package_get_no_advice(raise_in):
    assert raise_in("raise ValueError('no arm')", installed=True) == ""
