"""Which files a task is made of, and that a run knows when one of them has changed."""

import pytest

from rlctl.environments import registry
from rlctl.environments.own_files import digest_own_files

ENV = """
    import os
    import gymnasium
    from . import gains
    from .sensors.noise import add_noise
    from gymnasium import spaces
    MODEL = os.path.join(os.path.dirname(__file__), "models", "robot.xml")
    TERRAIN = "terrain/hills.npz"
"""


@pytest.fixture
def robot(write_module, monkeypatch, tmp_path):
    """A package whose entry point is a function; returns its folder."""
    monkeypatch.chdir(tmp_path)
    write_module("robot/__init__.py", "import gymnasium\ngymnasium.register('Robot-v0', 'robot.env:Robot')\n")
    write_module("robot/env.py", ENV)
    write_module("robot/gains.py", "from math import pi\n")
    write_module("robot/sensors/__init__.py", "")
    write_module("robot/sensors/noise.py", "from ..gains import pi\nimport robot.units\nadd_noise = pi\n")
    write_module("robot/units.py", "")
    write_module("robot/not_imported.py", "")
    for name, text in (
        ("models/robot.xml", '<mujoco><compiler meshdir="meshes"/><mesh file="foot.stl"/></mujoco>'),
        ("models/meshes/foot.stl", "solid"),
        ("models/other.xml", "<mujoco/>"),
        ("terrain/hills.npz", "1"),
    ):
        file = tmp_path / "robot" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return tmp_path / "robot"


def test_what_the_source_imports_and_names_and_nothing_else(robot):
    of_class = digest_own_files(robot / "env.py")
    files = ["gains.py", "models/meshes/foot.stl", "models/robot.xml", "sensors/noise.py", "terrain/hills.npz"]
    assert list(of_class) == [f"robot/{name}" for name in [*files, "units.py"]]
    assert set(digest_own_files(robot / "__init__.py")) == {*of_class, "robot/env.py"}
    assert digest_own_files(robot / "gains.py") == digest_own_files(None) == digest_own_files(robot / "gone.py") == {}


def test_a_source_that_cannot_be_read_needs_nothing(robot):
    (robot / "env.py").write_text(f"def broken(:\nMODEL = 'models/robot.xml'\n'{'long ' * 200}.xml'\n")
    assert digest_own_files(robot / "env.py") == {}
    (robot / "env.py").write_text(
        f"MODEL = 'models/robot.xml'\nwords = '{'long ' * 200}.xml', '*.xml', '../../x.xml'\n"
    )
    assert list(digest_own_files(robot / "env.py")) == ["robot/models/meshes/foot.stl", "robot/models/robot.xml"]


def test_a_file_alone_needs_what_lies_beside_it(write_module, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    file = write_module("walker.py", "import helper, numpy\nMODEL = 'walker.urdf'\n")
    write_module("helper.py", "")
    write_module("train_walker.py", "")
    (tmp_path / "walker.urdf").write_text('<robot><mesh filename="package://walker/legs.stl"/></robot>')
    (tmp_path / "legs.stl").write_text("solid")
    assert list(digest_own_files(file)) == ["helper.py", "legs.stl", "walker.urdf"]


@pytest.mark.parametrize("task", ["robot:Robot-v0", "robot.env:Robot"])
def test_a_changed_model_is_named(robot, task):
    before = {**registry.identify_task(task), "files_sha256": registry.identify_files(task)}
    assert registry.describe_task_changes(before, task) == []
    (robot / "models/robot.xml").write_text("<mujoco/>")
    (robot / "units.py").write_text("turn = 6.28\n")
    names = "robot/models/meshes/foot.stl, robot/models/robot.xml, robot/units.py"
    assert registry.describe_task_changes(before, task) == [f"{names} of {task} have changed since the run began"]
    assert registry.describe_task_changes(registry.identify_task(task), task) == []  # of an older run


def test_of_rlctls_own_tasks_the_version_says_it():
    assert registry.identify_files("reach") == {}


def test_an_import_from_above_all_folders_is_left_out(robot):
    (robot / "gains.py").write_text(f"from {'.' * 40} import pi\n")
    assert "robot/gains.py" in digest_own_files(robot / "env.py")
