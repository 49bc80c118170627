"""RL0: from a name to an environment, and what the environment says about itself."""

import re
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from rlctl.environments.info import space_to_json
from rlctl.errors import OldGymError
from rlctl.task.pybullet.library import pybullet_data
from tests.checking.judging import case, check_case, findings, mark_slow

ERROR = "error"
CASES = [
    case("broken_import.py:RL001Anything", ("RL001", ERROR)),
    case("broken_loading.py:RL002Raising", ("RL002", ERROR)),
    case("broken_loading.py:RL002RaisingUnreadably", ("RL002", ERROR)),
    case("broken_loading.py:RL002AnyAttribute", ("RL002", ERROR)),
    case("broken_loading.py:RL002RaisingProperty", ("RL002", ERROR)),
    case("broken_loading.py:RL002RaisingOfAnother", ("RL002", ERROR)),
    case("broken_loading.py:RL002NeedsArgumentsInside", ("RL002", ERROR)),
    case("broken_envs.py:RL003NoEnvironment", ("RL003", ERROR)),
    case("broken_envs.py:RL005Clean", ("RL005", ERROR)),
    case("broken_loading.py:RL006NeedsArguments", ("RL006", ERROR)),
    case("broken_loading.py:RL007NoFile", ("RL007", ERROR)),
    case("broken_loading.py:RL007NoModel", ("RL007", ERROR), pybullet=True),
    case("broken_loading.py:RL007NoModelAtReset", ("RL007", ERROR), pybullet=True),
    case("broken_old_gym.py:RL008Pushed", ("RL008", ERROR)),
    case("broken_spaces.py:RL008SpacesOfGym", ("RL008", ERROR)),
    case("broken_spaces.py:RL008ObservationOfGym", ("RL008", ERROR)),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


def test_arguments_are_named_and_how_to_give_them():
    (finding,) = findings("broken_loading.py:RL006NeedsArguments", "RL006")
    assert "missing 1 required positional argument: 'gain'" in finding.message
    assert "(--set task.gain=...)" in finding.fix


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("RL002RaisingUnreadably", r"UnreadableError: \(message unavailable: RuntimeError\)"),
        ("RL002AnyAttribute", "__getattr__ for an attribute that it lacks: KeyError: 'num_envs'"),
        ("RL002RaisingProperty", r"reading an attribute raises RuntimeError: not connected \(.*broken_loading.py:"),
        (
            "RL002RaisingOfAnother",
            "RuntimeError: install the extra .*; the first error was ModuleNotFoundError: No module",
        ),
        ("RL002NeedsArgumentsInside", "missing 1 required positional argument: 'link'"),
    ],
)
def test_what_a_constructor_raises_is_named(name, message):
    (finding,) = findings(f"broken_loading.py:{name}", "RL002", "RL006")
    assert re.search(message, finding.message)


@pytest.mark.slow
def test_an_exception_without_a_readable_message_is_a_finding_of_its_call():
    (finding,) = findings("broken_loading.py:RaisingUnreadablyInStep", "RL207")
    assert finding.message.startswith("step 1 raised UnreadableError: (message unavailable: RuntimeError)")


def test_a_warning_that_a_filter_makes_an_exception_is_explained():
    (finding,) = findings("broken_loading.py:WarnsWhereWarningsAreErrors", "RL002")
    assert "DeprecationWarning: path is deprecated" in finding.message
    assert finding.fix.startswith("It is a warning that a filter makes an exception: ")


def test_an_import_names_the_first_error_of_a_chain(tmp_path):
    file = tmp_path / "chained_import.py"
    file.write_text("try:\n    import no_such_module\nexcept ImportError as e:\n    raise RuntimeError('extra') from e")
    (finding,) = findings(f"{file}:Env", "RL001")
    assert "RuntimeError: extra" in finding.message
    assert "the first error was ModuleNotFoundError: No module named 'no_such_module'" in finding.message


def test_a_missing_class_gets_the_closest_name():
    (finding,) = findings("broken_envs.py:RL005Clean", "RL005")
    assert "has no 'RL005Clean'. Did you mean 'Clean'?" in finding.message


@pytest.mark.pybullet
def test_a_missing_model_is_named_with_the_search_path():
    (finding,) = findings("broken_loading.py:RL007NoModel", "RL007")
    data = Path(pybullet_data.getDataPath())
    assert finding.evidence["file"] == "kuka_iiwa/modell.urdf"
    assert finding.evidence["searched"] == [str(Path.cwd()), str(data)]
    assert finding.message.startswith("the constructor does not find 'kuka_iiwa/modell.urdf', looked for in ")


def test_a_missing_model_of_mujoco_is_named():
    pytest.importorskip("mujoco")
    (finding,) = findings("broken_loading.py:NoMujocoModel", "RL007")
    assert finding.evidence["file"] == "finger.xml"
    (finding,) = findings("broken_loading.py:NoMujocoEnvModel", "RL007")
    assert finding.evidence["file"] == "/nowhere/arm.xml"
    (finding,) = findings("broken_loading.py:NoMujocoTexture", "RL007")
    folder = "the folder of the model, or that of its meshdir or texturedir"  # and not the current one
    assert finding.message == f"the constructor does not find 'assets/grass.png', looked for in {folder}"


def test_a_missing_file_is_named_without_the_words_around_it():
    (finding,) = findings("broken_loading.py:NoTable", "RL007")
    assert finding.evidence["file"] == "data/table.csv"


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_missing_model_of_a_reset_is_named():
    (finding,) = findings("broken_loading.py:RL007NoModelAtReset", "RL007")
    assert finding.message.startswith("reset does not find 'robot.urdf', looked for in ")
    assert finding.evidence["searched"][0] == str(Path.cwd())


def test_an_id_that_only_the_old_gym_knows(monkeypatch):
    old = types.ModuleType("gym")
    old.envs = types.SimpleNamespace(registry=types.SimpleNamespace(env_specs={"Pushed-v0": object()}))
    monkeypatch.setitem(sys.modules, "gym", old)
    (finding,) = findings("Pushed-v0", "RL008")
    assert finding.rule == "RL008"
    assert "registered with the old gym" in finding.message


def test_a_class_of_the_old_gym(monkeypatch, tmp_path):
    old = types.ModuleType("gym")
    old.Env = type("Env", (), {"__module__": "gym.core"})
    monkeypatch.setitem(sys.modules, "gym", old)
    file = tmp_path / "of_old_gym.py"
    file.write_text(
        "import gym, numpy as np\nfrom gymnasium import spaces\n"
        "class Pushed(gym.Env):\n"
        "    observation_space = action_space = spaces.Box(-1, 1, (2,), np.float32)\n"
        "    def reset(self): return np.zeros(2, np.float32)\n"
        "    def step(self, action): return np.zeros(2, np.float32), 0.0, True, {}\n"
    )
    assert [finding.rule for finding in findings(f"{file}:Pushed", "RL003", "RL008")] == ["RL008"]


def test_consequences_of_the_old_gym_are_not_reported(monkeypatch, tmp_path):
    old = types.ModuleType("gym")
    old.Env = type("Env", (), {"__module__": "gym.core"})
    old.Box = type("Box", (), {"__module__": "gym.spaces.box", "shape": (2,), "sample": lambda self: np.zeros(2)})
    monkeypatch.setitem(sys.modules, "gym", old)
    file = tmp_path / "with_spaces_of_gym.py"
    file.write_text(
        "import gym\nclass Pushed(gym.Env):\n    observation_space = action_space = gym.Box()\n"
        "    def reset(self): return [0.0, 0.0]\n    def step(self, action): return [0.0, 0.0], 0.0, True, {}\n"
    )
    assert [finding.rule for finding in findings(f"{file}:Pushed", "RL008", "RL106", "RL109", "RL207")] == ["RL008"]
    with pytest.raises(
        OldGymError, match=r"is of the old gym package, not of Gymnasium\nwrite `import gymnasium as gym`"
    ):
        space_to_json(old.Box())


@pytest.mark.pybullet
def test_the_model_of_a_failed_call_is_named_as_it_was_computed(tmp_path):
    file = tmp_path / "computes_paths.py"
    file.write_text(
        "import os, gymnasium, pybullet as p\nFOLDER, NAME = '/no/such', 'robot'\n"
        "class Env(gymnasium.Env):\n    def __init__(self):\n"
        "        p.loadURDF(CALL, physicsClientId=p.connect(p.DIRECT))\n"
    )
    text = file.read_text()
    for number, call in enumerate(
        ("f'{FOLDER}/{NAME}.urdf'", "FOLDER + '/robot.urdf'", "os.path.join(FOLDER, 'robot.urdf')")
    ):
        other = file.with_stem(f"computes_{number}")
        other.write_text(text.replace("CALL", call))
        (finding,) = findings(f"{other}:Env", "RL007")
        assert finding.message.startswith("the constructor does not find '/no/such/robot.urdf'")


def test_an_id_whose_module_imports_what_is_not_there(monkeypatch, tmp_path):
    (tmp_path / "registers_with_gym.py").write_text("import gym\n")
    monkeypatch.syspath_prepend(tmp_path)
    (finding,) = findings("registers_with_gym:Pushed-v0", "RL008")
    assert finding.rule == "RL008"
    assert "No module named 'gym'" in finding.message
