"""The ros2_control template compiles against a stub, maps by names, and commands what the policy does."""

import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.exporting.controller.source import ControllerSource
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.policy.policy import Policy
from tests.exporting import controlled
from tests.exporting.controllers import make_policy, plan_of

EXAMPLE = Path(__file__).parent.parent / "examples" / "ros2_control"
STUB = Path(__file__).parent / "ros2_stub"
FLAGS = ["-O1", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.pybullet,
    pytest.mark.skipif(shutil.which("g++") is None or shutil.which("gcc") is None, reason="no gcc"),
]


@pytest.fixture(scope="module")
def policy():
    env = EnvSpec(f"{controlled.__file__}:Cart").make()
    info = describe(env)
    env.close()
    return make_policy(info, scale=0.5)


@pytest.fixture(scope="module")
def program(policy, tmp_path_factory):
    folder = tmp_path_factory.mktemp("ros2")
    code = ControllerSource(policy, plan_of(policy), "controller", None).write()
    (folder / "controller.h").write_text(code.header)
    (folder / "controller.c").write_text(code.source)
    run(folder, "gcc", "-std=c99", *FLAGS, "-c", "controller.c")
    includes = [f"-I{path}" for path in (folder, EXAMPLE / "include", STUB)]
    sources = [EXAMPLE / "src" / "rlctl_controller.cpp", STUB / "drive.cpp", "controller.o"]
    run(folder, "g++", "-std=c++17", *FLAGS, *includes, *sources, "-o", "drive")
    return folder / "drive"


def run(folder, *command):
    done = subprocess.run([*map(str, command)], cwd=folder, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done


def test_commands_are_those_of_the_policy(policy, program):
    lines = run(program.parent, program, "").stdout.splitlines()
    assert lines[0].split() == ["left/position", "right/position"] * 2  # commands, then states
    updates = [line.split() for line in lines[1:]]
    # At 20 Hz the policy acts in every second update. Without a goal nothing is commanded.
    assert updates[:2] == [["ok", "9", "9"]] * 2
    acting, places, goal, last = Policy(NumpyActor(policy)), np.array([0.25, -0.5]), np.array([0.5, -0.25]), np.zeros(2)
    for update in (2, 4, 6):
        observation = np.concatenate([*[places] * 3, goal - places, last]).astype(np.float32)
        last = acting.predict(observation)
        assert [float(value) for value in updates[update][1:]] == pytest.approx(places + 0.05 * last, rel=1e-4)
        assert updates[update + 1] == updates[update]
    assert updates[8] == updates[6]  # a joint without a position: the last target


@pytest.mark.parametrize(
    ("without", "code", "message"),
    [
        ("rate", 2, "update_rate 15 Hz: it must be a whole multiple of 10 Hz"),
        ("entry", 2, "inputs.places: 1 names, the policy takes 2 numbers [m]"),
        ("command", 3, "the hardware has no command interface left/position"),
        ("state", 3, "the hardware has no state interface right/position"),
    ],
)
def test_what_is_missing_is_refused(without, code, message, program):
    done = subprocess.run([program, without], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stderr.strip()) == (code, message)


def test_the_plugin_is_described_alike_everywhere():
    plugin = ElementTree.parse(EXAMPLE / "rlctl_controller.xml").getroot().find("class")
    package = ElementTree.parse(EXAMPLE / "package.xml").getroot()
    source = (EXAMPLE / "src" / "rlctl_controller.cpp").read_text()
    assert f"PLUGINLIB_EXPORT_CLASS({plugin.get('type')}, {plugin.get('base_class_type')})" in source
    assert package.findtext("name") == "rlctl_controller"
    assert f"type: {plugin.get('name')}" in (EXAMPLE / "config" / "reach.yaml").read_text()
    needed = {element.text for element in package.findall("depend")}
    assert needed <= set((EXAMPLE / "CMakeLists.txt").read_text().replace(")", " ").split())
