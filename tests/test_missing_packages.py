"""What to install for a module that is missing, wherever it is imported."""

import os
import re
import sys
from pathlib import Path

import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError, UsageError, describe_exception, explain_left_out
from rlctl.missing_packages import advise, advise_on

ENV = """
    import gymnasium
    {top}
    class E(gymnasium.Env):
        observation_space = action_space = gymnasium.spaces.Box(-1, 1, (1,))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            {inside}
"""


@pytest.fixture(autouse=True)
def _own_imports(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for module in ("cv2", "gym"):
        monkeypatch.setitem(sys.modules, module, None)  # as if it were not installed


@pytest.mark.parametrize(
    ("module", "advice"),
    [
        ("cv2", "; pip install opencv-python"),
        ("PIL.Image", "; pip install Pillow"),
        ("yaml", "; pip install PyYAML"),
        ("sklearn.cluster", "; pip install scikit-learn"),
        ("robot_descriptions", "; pip install robot-descriptions"),
        ("pkg_resources", "; pip install 'setuptools<81'"),
        ("my_own_module", ""),
    ],
)
def test_the_package_of_a_module(module, advice):
    assert advise(ModuleNotFoundError(f"No module named '{module}'", name=module)) == advice


def test_what_replaces_a_package():
    assert "import gymnasium as gym" in advise_on("gym")
    # Its own modules are installed with PyBullet, and import the old gym.
    assert "pip install pybullet-envs-gymnasium" in advise_on("pybullet_envs")
    assert "pip install pybullet-envs-gymnasium" in advise_on("gym", importer="pybullet_envs")


def test_an_exception_behind_another():
    error = RuntimeError("no camera")
    error.__cause__ = ModuleNotFoundError(name="cv2")
    assert describe_exception(error) == "RuntimeError: no camera; pip install opencv-python"


def test_a_missing_library_of_the_system():
    error = ImportError("libGL.so.1: cannot open shared object file: No such file or directory")
    assert advise(error).endswith("pip install opencv-python-headless, which needs no display")


def test_an_import_of_an_environment(write_module):
    write_module("top.py", ENV.format(top="import cv2", inside="pass"))
    with pytest.raises(TaskError, match=r"cv2.* \(top.py:3\); pip install opencv-python$"):
        EnvSpec("top.py:E").make()
    with pytest.raises(UsageError, match=r"no module 'skimage' is installed or under .*; pip install scikit-image$"):
        EnvSpec("skimage:E").make()


@pytest.mark.slow
def test_an_import_inside_of_reset(rlctl, write_module):
    write_module("late.py", ENV.format(top="import sys; sys.modules['cv2'] = None", inside="import cv2"))
    done = rlctl("train", "late.py:E", "-n", "100", "--no-check")
    assert "None in sys.modules; pip install opencv-python" in done.stderr
    done = rlctl("check-env", "late.py:E", "--select", "RL2")
    assert "None in sys.modules (late.py:9); pip install opencv-python" in done.stdout


def test_check_env_gives_it_as_the_fix(rlctl, write_module):
    source = "import sys\nsys.modules['{0}'] = None\nimport {0}\n"
    write_module("camera.py", source.format("cv2"))
    write_module("old.py", source.format("gym"))
    assert "fix: pip install opencv-python\n" in rlctl("check-env", "camera.py:E").stdout
    done = rlctl("check-env", "old.py:E").stdout
    assert "RL008" in done
    assert "fix: gym is the old Gymnasium: write `import gymnasium as gym`" in done


def test_a_requirement_of_rlctl_that_is_missing_is_named(installed_rlctl, monkeypatch):
    monkeypatch.setenv("HIDE_PACKAGES", "rerun")
    folders = [str(Path(__file__).parent / "hidden"), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(folders))
    done = installed_rlctl("replay", "reach", "--policy", "zero")
    assert (done.returncode, done.stdout) == (2, "")
    assert re.search(r"^error: this needs rerun, which is not installed here: pip install '?rerun-sdk", done.stderr)
    assert explain_left_out("rerun.nothing") is None  # it is installed here
    assert explain_left_out("no_module_of_rlctl") is None
