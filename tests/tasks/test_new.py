"""`rlctl tasks new`: the plugin it writes works as it is, installed or not."""

import contextlib
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from rlctl.engine import MUJOCO
from rlctl.environments import registry
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.tasks import new
from tests import fork_server
from tests.task import mesh_files

ROOT = Path(__file__).parents[2]
FILES = {
    "README.md",
    "pyproject.toml",
    "my_arm/__init__.py",
    "my_arm/arm.urdf",
    "my_arm/recipe.schema.json",
    "my_arm/task.py",
    "my_arm/task.yaml",
    "tests/test_task.py",
}
PATH_FORM = "my-arm/my_arm/task.py:MyArm"


def run(*arguments: object, cwd: Path, path: Path | None = None) -> str:
    """Run a Python module in `cwd`, with `path` before the installed packages; return its stdout."""
    env = {**os.environ, **({"PYTHONPATH": str(path)} if path else {})}
    command = [sys.executable, "-m", *map(str, arguments)]
    done = fork_server.for_commands().run(command, cwd=cwd, env=env)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def written(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """A plugin `my-arm` in the current folder, `tmp_path`."""
    monkeypatch.chdir(tmp_path)
    return new.create("my-arm")


def test_what_is_written_and_printed(rlctl, tmp_path):
    result = rlctl("tasks", "new", "my-arm")
    assert (result.returncode, result.stderr) == (0, "")
    assert written(tmp_path / "my-arm") == FILES
    assert [file.name for file in tmp_path.iterdir()] == ["my-arm"]  # nothing temporary is left
    assert f"  rlctl check-env {PATH_FORM}" in result.stdout.splitlines()
    text = "".join(file.read_text() for file in (tmp_path / "my-arm").rglob("*.[pytum]*"))
    assert "$" not in text.replace("$schema=recipe.schema.json", "")  # no placeholder is left


def test_json(rlctl):
    content = json.loads(rlctl("tasks", "new", "my-arm", "--json", "-").stdout)
    assert (content["name"], content["folder"], content["target"]) == ("my-arm", "my-arm", PATH_FORM)
    assert set(content["files"]) == {f"my-arm/{file}" for file in FILES}


def test_it_reads_like_the_rest(plugin):
    run("ruff", "format", "--check", "--isolated", "--line-length", "120", cwd=plugin.folder)
    # Without RUF012: a task assigns its definition on the class, without annotations.
    rules = "E,F,W,I,UP,B,SIM,C4,PT,RET,PIE,NPY"
    run("ruff", "check", "--isolated", "--line-length", "120", "--select", rules, cwd=plugin.folder)


@pytest.mark.slow
def test_it_passes_every_check_before_it_is_installed(rlctl, plugin):
    result = rlctl("check-env", PATH_FORM, "--strict")
    assert result.returncode == 0, result.stdout
    assert "no findings" in result.stdout


@pytest.mark.slow
def test_its_own_tests_pass_before_it_is_installed(plugin, tmp_path):
    assert "4 passed" in run("pytest", "-q", "-p", "no:cacheprovider", "my-arm", cwd=tmp_path)


def test_its_recipe_is_found_installed_or_not(rlctl, plugin, install, tmp_path):
    assert registry.find_recipe_file(PATH_FORM) == Path("my-arm/my_arm/task.yaml")
    files = {str(file): (plugin.folder / file).read_text() for file in plugin.files if file.parts[0] == "my_arm"}
    site = install("my-arm", {"my-arm": "my_arm.task:MyArm"}, files)
    shown = json.loads(rlctl("tasks", "show", "my-arm", "--json", "-", path=site).stdout)
    assert shown["recipe_file"] == str(site / "my_arm/task.yaml")
    assert (shown["distribution"], shown["recipe"]["n_envs"]) == ("my-arm", 32)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "my arm",
            "name 'my arm': use letters, digits, - and _; begin with a letter, "
            "end with a letter or digit, such as 'my-arm'",
        ),
        ("3d", "use letters, digits, - and _; begin with a letter, end with a letter or digit, such as 'd'"),
        ("arm-", "such as 'arm'"),
        ("../arm", "such as 'arm'"),
        ("", "name '': use letters"),
        ("reach", "task 'reach' of rlctl "),
        ("tests", "the plugin's folder of tests has that name"),
        ("latest", "means the newest run"),
        ("class", "class is a Python keyword"),
        ("numpy", "module 'numpy' already exists"),
        ("stable-baselines3", "module 'stable_baselines3' already exists"),
        ("sb3-contrib", "module 'sb3_contrib' already exists"),
    ],
)
def test_names_that_cannot_be(tmp_path, monkeypatch, name, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError) as caught:
        new.create(name)
    assert message in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "package", "cls"),
    [
        ("my-arm", "my_arm", "MyArm"),
        ("Gripper2", "gripper2", "Gripper2"),
        ("pick_and-place", "pick_and_place", "PickAndPlace"),
        ("box", "box", "BoxTask"),  # the template imports a Box
        ("none", "none", "NoneTask"),
    ],
)
def test_names_made_from_the_name(tmp_path, monkeypatch, name, package, cls):
    monkeypatch.chdir(tmp_path)
    plugin = new.create(name)
    assert (plugin.package, plugin.cls) == (package, cls)
    for file in tmp_path.rglob("*.py"):
        compile(file.read_text(), file, "exec")


ROBOT = """<?xml version="1.0"?>
<robot name="two arms"><link name="base"/>{links}{joints}
<gazebo><plugin filename="libplugin.so"/></gazebo></robot>"""


@pytest.fixture
def model(tmp_path, monkeypatch):
    """An arm on a slide, with a gripper, a frame at its tip and a mesh elsewhere: its last three joints have no limits
    of force."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "given" / "stl").mkdir(parents=True)
    mesh_files.write_stl(tmp_path / "given" / "stl" / "part.stl")
    part = '<geometry><mesh filename="stl/part.stl" scale="0.1 0.1 0.1"/></geometry>'
    inertial = (
        '<inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    names = ["sled", "upper_arm", "forearm", "finger"]
    links = "".join(f'<link name="{name}">{inertial}<collision>{part}</collision></link>' for name in names)
    chain = [("rail", "base", "sled"), ("lift", "sled", "upper_arm"), ("bend", "upper_arm", "forearm")]
    chain += [("grip", "forearm", "finger"), ("mount", "forearm", "tool_frame")]
    joints = ""
    for name, parent, child in chain:
        kind = {"rail": "prismatic", "mount": "fixed"}.get(name, "revolute")
        effort = {"rail": 20}.get(name, 0)
        joints += (
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="0.2 0 0.1"/><axis xyz="0 1 0"/><limit lower="0.1" upper="1.1" '
            f'effort="{effort}" velocity="1"/></joint>'
        )
    file = tmp_path / "given" / "arm.urdf"
    file.with_suffix(".urdf.xacro").touch()
    file.write_text(ROBOT.format(links=links + '<link name="tool_frame"/>', joints=joints))
    return file


@pytest.mark.slow
def test_a_plugin_of_a_users_own_model(model, tmp_path):
    plugin = new.create("two-arms", model="given/arm.urdf")
    package = plugin.folder / "two_arms"
    assert (package / "meshes" / "part.stl").read_bytes() == (model.parent / "stl" / "part.stl").read_bytes()
    copy = model.read_text().replace("stl/part.stl", "meshes/part.stl")
    assert (package / "arm.urdf").read_text() == copy
    code = (package / "task.py").read_text()
    assert 'TIP = "tool_frame"' in code
    assert 'JOINTS = ["rail", "lift", "bend"]' in code
    # The slide 0.5 m/s of 1; no limit of force except the first.
    assert "MAX_SPEED = [0.5, 1.0, 1.0, 1.0]" in code
    assert "MAX_FORCE = [20.0, 10.0, 10.0, 10.0]" in code
    assert "START = np.array([0.2, 0.2, 0.2, 0.2])" in code  # 0 is below the limits: a tenth of the range inside
    with contextlib.closing(EnvSpec("two-arms/two_arms/task.py:TwoArms", sim=MUJOCO).make()) as env:
        env.reset(seed=0)
        task = env.unwrapped.task
        before = task.target
        for _ in range(5):
            env.step(np.full(3, -1.0))
        # Whole steps of the targets, 0.5 m/s and 1 rad/s for 5/30 s, up to the limits; the gripper stays.
        assert task.target == pytest.approx(np.maximum(before - np.array([0.5, 1, 1]) / 6, 0.1))
        assert task.arm.joint_positions[3] == pytest.approx(0.2, abs=0.02)
    plugin = new.create("finger", model="given/arm.urdf", link="finger")
    assert 'JOINTS = ["rail", "lift", "bend", "grip"]' in (plugin.folder / "finger" / "task.py").read_text()


def test_an_mjcf_model_becomes_one_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "given" / "assets").mkdir(parents=True)
    mesh_files.write_stl(tmp_path / "given" / "assets" / "part.stl")
    parts = '<mujoco><asset><mesh file="part.stl"/></asset></mujoco>'
    (tmp_path / "given" / "parts.xml").write_text(parts)
    (tmp_path / "given" / "arm.xml").write_text(
        """<mujoco model="arm"><compiler meshdir="assets" angle="radian"/><include file="parts.xml"/><worldbody>
        <geom type="plane" size="1 1 1"/>
        <body name="base"><geom size="0.1"/><body name="arm" pos="0 0 0.3"><joint name="lift" axis="0 1 0" range="-1 1"
        actuatorfrcrange="-5 5"/><geom type="mesh" mesh="part"/></body></body></worldbody></mujoco>"""
    )
    plugin = new.create("lifter", model="given/arm.xml", link="arm")
    (tmp_path / "given").rename(tmp_path / "gone")
    with contextlib.closing(MujocoSim(control_dt=0.02, substeps=2)) as sim:
        arm = sim.load("arm", plugin.folder / "lifter" / "arm.xml", fixed=True)
        assert (arm.joint_names, arm.joint_max_force.tolist(), arm.joint_low.tolist()) == (["lift"], [5.0], [-1.0])
        assert sim.model.nmesh == 1
    with contextlib.closing(EnvSpec("lifter/lifter/task.py:Lifter", sim=MUJOCO).make()) as env:
        assert list(env.unwrapped.sim.bodies) == ["arm"]  # the file has a floor


@pytest.mark.slow
def test_the_plugin_of_a_model_reads_well_and_passes_its_tests(model, tmp_path):
    plugin = new.create("slow-arm", model="given/arm.urdf")
    test_it_reads_like_the_rest(plugin)
    assert "4 passed" in run("pytest", "-q", "-p", "no:cacheprovider", "slow-arm", cwd=tmp_path)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"model": "given/amr.urdf"}, "--model: model file 'given/amr.urdf' not found. That folder has: arm.urdf"),
        (
            {"model": "amr.urdf"},
            "--model: model file 'amr.urdf' not found. That folder has: no file that ends in .urdf",
        ),
        ({"model": "given/arm.urdf.xacro"}, "reads URDF and MJCF (.xml) files; first: xacro arm.urdf.xacro > arm.urdf"),
        ({"model": "plane.urdf"}, "--model plane.urdf: it has no joints; this makes a task for an arm"),
        (
            {"model": "given/arm.urdf", "link": "tool"},
            "--link: arm.urdf has no link or site 'tool'. Did you mean 'tool_frame'?",
        ),
        ({"model": "given/arm.urdf", "link": "base"}, "--link 'base': no joint moves it; choose another of: sled"),
        ({"link": "tip"}, "--link needs --model"),
    ],
)
def test_models_that_cannot_be(model, given, message):
    with pytest.raises(UsageError) as caught:
        new.create("my-arm", **given)
    assert message in str(caught.value)
    assert not Path("my-arm").exists()


@pytest.mark.parametrize("command", ["check-env", "replay"])
def test_a_model_file_is_no_task(rlctl, model, command):
    result = rlctl(command, "given/arm.urdf")
    assert result.returncode == 2
    hint = "`rlctl tasks new NAME --model given/arm.urdf` makes a task of it"
    assert result.stderr == f"error: given/arm.urdf: a model file, not a task: {hint}\n"


def test_an_existing_folder_is_left_alone(rlctl, tmp_path):
    (tmp_path / "my-arm").mkdir()
    result = rlctl("tasks", "new", "my-arm")
    assert result.returncode == 2
    assert result.stderr == "error: my-arm already exists; choose another name or another folder\n"
    assert written(tmp_path) == set()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_from_the_wheel_to_a_policy(tmp_path):
    options = ("--no-deps", "--no-build-isolation", "--quiet")
    run("pip", "wheel", *options, "--wheel-dir", tmp_path / "dist", ROOT, cwd=tmp_path)
    (wheel,) = (tmp_path / "dist").glob("rlctl-*.whl")
    site = tmp_path / "site"
    run("pip", "install", "--no-deps", "--quiet", "--target", site, wheel, cwd=tmp_path)
    files = json.loads(run("rlctl", "tasks", "new", "my-arm", "--json", "-", cwd=tmp_path, path=site))["files"]
    assert set(files) == {f"my-arm/{file}" for file in FILES}

    run("pip", "install", *options, "--target", site, "./my-arm", cwd=tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    shown = json.loads(run("rlctl", "tasks", "show", "my-arm", "--json", "-", cwd=empty, path=site))
    assert shown["file"] == str(site / "my_arm/task.py")
    run("rlctl", "check-env", "my-arm", "--strict", cwd=empty, path=site)
    run("pytest", "-q", "-p", "no:cacheprovider", tmp_path / "my-arm", cwd=empty, path=site)
    for seed in range(3):
        result = json.loads(run("rlctl", "train", "my-arm", "--seed", seed, "--json", "-", cwd=empty, path=site))
        assert result["best"]["episodes"] == 40
        assert result["best"]["success_rate"] >= 0.95
