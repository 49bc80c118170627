"""From what the user typed to an environment, and what is said when there is none."""

import hashlib
import os
import subprocess
import sys
import textwrap
from importlib.util import spec_from_file_location
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import rlctl
from rlctl.environments import own_ids, registry
from rlctl.environments.spec import EnvSpec
from rlctl.environments.suggestions import find_only_class
from rlctl.errors import NoDisplayError, RecipeError, TaskError, UsageError, did_you_mean

ENV = """
    import gymnasium, numpy as np
    from gymnasium.spaces import Box

    class MyEnv(gymnasium.Env):
        observation_space, action_space = Box(-1, 1, (2,)), Box(-1, 1, (1,))

        def __init__(self, gain=1.0):
            self.gain, self.count = gain, 0

        def reset(self, *, seed=None, options=None):
            self.count = 0
            return np.full(2, 0.0, np.float32), {}

        def step(self, action):
            self.count += 1
            return np.full(2, 0.1 * self.count, np.float32), 0.0, False, False, {}

    def make_it(gain=2.0):
        return MyEnv(gain)

    class NoEnv:
        pass

    number = 3
"""


@pytest.fixture(autouse=True)
def _own_imports(tmp_path, monkeypatch):
    """Work in `tmp_path`, and forget what was imported from it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


@pytest.fixture
def my_env(write_module):
    return write_module("my_env.py", ENV)


def error(kind, task, *arguments, **options):
    with pytest.raises(kind) as caught:
        EnvSpec(task, *arguments, **options).make()
    return str(caught.value)


def test_every_form_of_a_task(my_env, write_module):
    write_module("package/__init__.py", "")
    write_module("package/envs.py", ENV)
    for task in ("my_env.py:MyEnv", f"{my_env}:MyEnv", "my_env:MyEnv", "package.envs:MyEnv", "package.envs:make_it"):
        env = EnvSpec(task).make()
        assert type(env).__name__ == "MyEnv", task
    assert EnvSpec("my_env.py:MyEnv", {"gain": 4.0}).make().gain == 4.0
    assert EnvSpec("package.envs:make_it").make().gain == 2.0
    for task in ("reach", "rlctl_manipulation.reach:Reach"):
        env = EnvSpec(task).make()
        assert type(env.unwrapped.task).__name__ == "Reach"
        env.close()
    assert type(EnvSpec("Pendulum-v1").make().unwrapped).__name__ == "PendulumEnv"


def test_resolving_a_name_leaves_the_path_alone(my_env):
    before = [*sys.path]
    for task in ("my_env:MyEnv", "my_env.py:MyEnv", "reach", "Pendulum-v1", "nowhere:E"):
        registry.find_source_file(task)
        registry.find_recipe_file(task)
    assert registry.find_source_file("my_env:MyEnv") == my_env
    for task in ("reach", "Pendulum-v1"):
        registry.load(task)
    assert sys.path == before
    registry.load("my_env:MyEnv")
    assert sys.path == [*before, str(my_env.parent)]


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_strangers_modules_in_the_current_folder_are_not_run(installed_rlctl, write_module):
    for name in ("numpy", "json", "signal", "torch", "gymnasium", "rlctl_manipulation", "typer"):
        write_module(f"{name}.py", f"raise SystemExit('a file of the current folder was imported: {name}')\n")
    done = installed_rlctl("eval", "reach", "--pretrained", "--episodes", "2", "--n-envs", "2")
    assert (done.returncode, "2 episodes" in done.stdout) == (0, True), done.stderr
    write_module("pendulum.py", "from gymnasium.envs.classic_control import PendulumEnv\n")
    done = installed_rlctl("check-env", "pendulum:PendulumEnv", "--select", "RL1")
    assert "current folder" not in done.stderr, done.stderr


def test_a_file_is_imported_once(my_env):
    assert registry.load("my_env.py:MyEnv") is registry.load(f"{my_env}:MyEnv") is registry.load("my_env:MyEnv")


def test_a_file_may_import_its_neighbours(write_module):
    write_module("there/parts.py", ENV)
    write_module("there/whole.py", "from parts import MyEnv\n")
    assert EnvSpec("there/whole.py:MyEnv").make().gain == 1.0


def test_a_file_in_a_package_is_a_module_of_it(write_module, monkeypatch):
    write_module("there/wheeled/__init__.py", "from .limits import GAIN\n")
    write_module("there/wheeled/limits.py", "GAIN = 3.0\n")
    write_module("there/wheeled/arms/__init__.py", "")
    file = write_module("there/wheeled/arms/arm.py", f"from ..limits import GAIN\nimport parts\n{textwrap.dedent(ENV)}")
    write_module("there/wheeled/arms/parts.py", "")
    loaded = registry.load("there/wheeled/arms/arm.py:MyEnv")
    assert (loaded.__module__, sys.modules["wheeled.arms.arm"].GAIN) == ("wheeled.arms.arm", 3.0)
    assert sys.path[-2:] == [str(file.parents[2]), str(file.parent)]
    assert registry.load("there/wheeled/__init__.py:GAIN.hex")() == (3.0).hex()
    monkeypatch.chdir("there")
    assert registry.load("wheeled.arms.arm:MyEnv") is loaded


@pytest.mark.parametrize(("package", "taken_from"), [("json", "json/__init__.py"), ("sys", "its own modules")])
def test_a_package_whose_name_is_taken(write_module, package, taken_from):
    write_module(f"there/{package}/__init__.py", "")
    write_module(f"there/{package}/arm.py", ENV)
    first, second = error(UsageError, f"there/{package}/arm.py:MyEnv").splitlines()
    assert f"arm.py belongs to the package {Path.cwd() / 'there' / package}, but Python imports {package!r}" in first
    assert first.endswith(taken_from)
    assert second == f"rename the folder {package!r}, or delete its __init__.py"


def test_a_package_that_is_also_installed(write_module):
    file = write_module("there/gymnasium/spaces/box.py", ENV)
    for folder in (file.parent, file.parent.parent):
        (folder / "__init__.py").touch()
    fix = error(UsageError, "there/gymnasium/spaces/box.py:Box").splitlines()[1]
    assert fix.startswith("name the installed module, gymnasium.spaces.box:Box; or rename the folder 'gymnasium', or ")


def test_files_of_one_name_in_many_folders(write_module):
    for number in range(3):
        write_module(f"v{number}/same.py", ENV.replace("gain=1.0", f"gain={number}"))
    for _ in range(2):
        classes = [registry.load(f"v{number}/same.py:MyEnv") for number in range(3)]
        assert [cls().gain for cls in classes] == [0, 1, 2]
        assert [sys.modules[cls.__module__].MyEnv for cls in classes] == classes


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize("name", ["random", "types", "json", "turtle"])
def test_a_file_named_like_a_standard_module(write_module, name):
    write_module(f"envs/{name}.py", ENV)
    assert EnvSpec(f"envs/{name}.py:MyEnv").make().gain == 1.0
    again = subprocess.run([sys.executable, "-c", f"import {name}; print({name}.__file__)"], capture_output=True)
    assert b"envs" not in again.stdout
    if name in sys.modules:
        assert not hasattr(sys.modules[name], "MyEnv")


def test_python_api_takes_parameters():
    env = rlctl.make("reach", tolerance=0.02)
    assert env.unwrapped.task.tolerance == 0.02
    env.close()


def test_an_unknown_name_gives_the_closest():
    assert error(UsageError, "reech").startswith("no task 'reech'. Did you mean 'reach'? Installed: ")
    assert error(UsageError, "~reach").startswith("no task '~reach'. Did you mean 'reach'? Installed: ")
    assert error(UsageError, "reech").endswith("Other forms: package.module:Class, path/to/file.py:Class, Pendulum-v1.")
    assert error(UsageError, "Hopper-V5").startswith("no task 'Hopper-V5'. Did you mean 'Hopper-v5'? Installed: ")
    with pytest.raises(UsageError, match=r"no environment 'hopper-v5'\. Did you mean 'Hopper-v5'\?"):
        registry.check_registered(registry.load("hopper-v5"))
    assert UsageError("").exit_code == 2


def test_a_name_in_other_letters_and_initials_are_the_closest():
    presets = ["presets/xqc", "presets/ppo", "presets/tqc"]
    assert did_you_mean("presets/PPO", presets) == " Did you mean 'presets/ppo'?"
    assert did_you_mean("lr", ["gamma", "learning_rate", "tau"]) == " Did you mean 'learning_rate'?"
    assert did_you_mean("bs", ["gamma", "batch_size"]) == " Did you mean 'batch_size'?"


def test_a_folder_is_named_as_one(my_env, tmp_path):
    (tmp_path / "my-arm").mkdir()
    with pytest.raises(UsageError, match=r"^my-arm is a folder, not a task: pip install -e my-arm"):
        registry.load("my-arm")


def test_places_that_are_not_there(my_env, tmp_path):
    assert error(UsageError, "my_env.py:MyEnvs") == (
        "my_env.py has no 'MyEnvs'. Did you mean 'MyEnv'? It defines: MyEnv, NoEnv."
    )
    assert error(UsageError, "sensor.py:E") == f"task 'sensor.py:E': no file {tmp_path / 'sensor.py'}"
    assert error(UsageError, "nowhere.envs:E") == (
        f"task 'nowhere.envs:E': no module 'nowhere.envs' is installed or under {tmp_path}"
    )
    assert error(UsageError, "my_env.py:number") == "my_env.py:number: number is of type int, not a class or a function"
    assert error(TaskError, "my_env.py:NoEnv") == (
        "my_env.py:NoEnv: NoEnv is neither a Gymnasium environment (reset, step, spaces) nor "
        "a subclass of rlctl.task.Task"
    )


@pytest.mark.slow_except(first=3)
@pytest.mark.parametrize(
    ("task", "meant"),
    [
        ("my_evn.py:MyEnv", "my_env.py:MyEnv"),
        ("my_evn:MyEnv", "my_env:MyEnv"),
        ("./my_env:MyEnv", "./my_env.py:MyEnv"),
        ("my_env.py::MyEnv", "my_env.py:MyEnv"),
        ("my_env.py MyEnv", "my_env.py:MyEnv"),
        ("my_env/MyEnv", "my_env.py:MyEnv"),
        ("package.envs.MyEnv", "package.envs:MyEnv"),
        ("package/evns.py:MyEnv", "package/envs.py:MyEnv"),
    ],
)
def test_a_task_in_another_form(my_env, write_module, task, meant):
    write_module("package/__init__.py", "")
    write_module("package/envs.py", ENV)
    assert f". Did you mean {meant!r}?" in error(UsageError, task)


def test_a_module_without_its_class(my_env, write_module):
    write_module("package/__init__.py", "")
    write_module("package/envs.py", f"{ENV}\n    class Derived(MyEnv):\n        pass\n")
    assert ". Did you mean 'package.envs:MyEnv' or 'package.envs:Derived'?" in error(UsageError, "package.envs")


def test_an_id_without_its_version():
    assert ". Did you mean 'half-cheetah' or 'HalfCheetah-v5'?" in error(UsageError, "HalfCheetah")


@pytest.mark.parametrize(
    ("source", "only"),
    [
        (ENV, "one.py:MyEnv"),
        (f"{ENV}\n    class _Private(MyEnv):\n        pass\n", "one.py:MyEnv"),
        (f"{ENV}\n    class Derived(MyEnv):\n        pass\n", ""),
        ("class Helper:\n    pass\n", ""),
    ],
)
def test_the_only_environment_class_of_a_file(my_env, write_module, source, only):
    write_module("one.py", source)
    assert find_only_class("one.py") == only


def test_an_id_is_named_by_the_installed_package_not_its_folder(my_env, write_module, monkeypatch, tmp_path):
    write_module("src/in_src/__init__.py", "import gymnasium\n\ngymnasium.register('InSrc-v0', 'in_src.env:Env')\n")
    monkeypatch.syspath_prepend(str(tmp_path / "src"))
    assert error(UsageError, "InSrc-v0").endswith(": write in_src:InSrc-v0")


def test_a_name_without_its_class(my_env):
    assert error(UsageError, "my_env.py:").endswith("to name a class in my_env.py: my_env.py:MyEnv")


def test_a_vectorised_environment_is_named_as_one(my_env, write_module):
    write_module("many.py", "import gymnasium\n\ndef make():\n    return gymnasium.make_vec('CartPole-v1', 2)\n")
    with pytest.raises(TaskError, match=r"many.py:make: CartPoleVectorEnv is a vectorised environment\ngive a single"):
        EnvSpec("many.py:make").make()


@pytest.mark.slow
def test_gymnasium_ids(write_module, monkeypatch):
    assert error(UsageError, "Pendulun-v1") == (
        "Gymnasium has no environment 'Pendulun-v1'. Did you mean 'Pendulum-v1'? "
        "If a package registers it, write PACKAGE:Pendulun-v1."
    )
    assert error(UsageError, "Pendulum-v9").startswith(
        "Gymnasium has no environment 'Pendulum-v9'. Did you mean 'Pendulum-v1'?"
    )
    assert error(UsageError, "nopackage:Env-v0").startswith("Gymnasium: nopackage:Env-v0: No module named 'nopackage'")
    registers = "\n".join(
        f"    gymnasium.register('{name}', entry_point=MyEnv)" for name in ("brings/My-v0", "brings/Plain")
    )
    write_module("brings.py", f"{ENV}\n{registers}\n")
    for task in ("brings:brings/My-v0", "brings:brings/Plain"):
        env = EnvSpec(task, {"gain": 5.0}).make()
        assert env.unwrapped.gain == 5.0
    assert EnvSpec("Pendulum-v1", {"g": 1.0, "max_episode_steps": 7}).make().spec.max_episode_steps == 7


def test_the_file_of_an_ids_class_is_hashed_without_an_import(write_module, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    write_module(
        "team/__init__.py",
        """
        import gymnasium
        class Own: pass
        gymnasium.register("Dock-v0", entry_point="team.dock:Dock")
        gymnasium.register(entry_point=Own, id="Own-v0")
        raise SystemExit("imported")
        """,
    )
    file = write_module("team/dock.py", "class Dock: pass\n")
    before = registry.identify_task("team:Dock-v0")
    assert before["source_sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
    assert registry.describe_task_changes(before, "team:Dock-v0") == []
    file.write_text("class Dock: changed = True\n")
    assert registry.describe_task_changes(before, "team:Dock-v0") == [f"{file} has changed since the run began"]
    assert own_ids.find_class_file("team:Own-v0") == tmp_path / "team/__init__.py"
    for unknown in ("team:Other-v0", "nopackage:Dock-v0", "Pendulum-v1"):
        assert registry.identify_task(unknown)["source_sha256"] is None


def test_a_gymnasium_id_whose_class_cannot_be_imported(write_module):
    write_module("registers.py", "import gymnasium\ngymnasium.register('Late-v0', entry_point='late:Late')\n")
    write_module("late.py", "1 / 0\n")
    assert error(TaskError, "registers:Late-v0") == (
        "task 'registers:Late-v0': import failed: ZeroDivisionError: division by zero (late.py:1)"
    )


def test_parameters_that_are_not_there(my_env, write_module):
    assert error(RecipeError, "my_env.py:MyEnv", {"gian": 1}) == (
        "task.gian: my_env.py:MyEnv has no parameter 'gian'. Did you mean 'gain'? It has: gain."
    )
    assert error(RecipeError, "reach", {"tolerence": 0.1}) == (
        "task.tolerence: Reach has no parameter 'tolerence'. Did you mean 'tolerance'? "
        "It has: tolerance, goal_low, goal_high, start_noise."
    )
    assert error(RecipeError, "Pendulum-v1", {"gg": 1}).startswith(
        "task.gg: Pendulum-v1 has no parameter 'gg'. Did you mean 'g'?"
    )
    write_module("teams.py", f"{ENV}\n    gymnasium.register('Dock-v0', entry_point=MyEnv)\n")
    assert error(RecipeError, "teams:Dock-v0", {"gian": 1}) == (
        "task.gian: teams:Dock-v0 has no parameter 'gian'. Did you mean 'gain'? It has: gain."
    )


def test_a_parameter_that_only_the_base_class_could_take(write_module):
    passes = """
    class Passes(MyEnv):
        def __init__(self, speed=1.0, **others):
            super().__init__(**others)

    class Fails(MyEnv):
        def __init__(self, **others):
            super().__init__(gian=2)

    gymnasium.register("Passes-v0", entry_point=Passes)
    """
    write_module("passes.py", f"{ENV}\n{passes}")
    unknown = "has no parameter 'gian'. Did you mean 'gain'? It has: speed, gain."
    assert error(RecipeError, "passes:Passes-v0", {"gian": 1}) == f"task.gian: passes:Passes-v0 {unknown}"
    assert error(RecipeError, "passes.py:Passes", {"gian": 1}) == f"task.gian: passes.py:Passes {unknown}"
    assert EnvSpec("passes:Passes-v0", {"gain": 3.0}).make().unwrapped.gain == 3.0
    assert "unexpected keyword argument" in error(TaskError, "passes.py:Fails", {"gain": 1})


def test_an_id_of_a_module_is_checked_before_it_is_built(write_module):
    write_module("moored.py", f"{ENV}\n    gymnasium.register('Moored-v0', entry_point=MyEnv)\n")
    registry.check_registered(registry.load("moored:Moored-v0"))
    with pytest.raises(UsageError, match="Did you mean 'moored:Moored-v0'"):
        registry.check_registered(registry.load("moored:Mored-v0"))


def test_parameters_of_another_type():
    assert error(RecipeError, "reach", {"tolerance": "abc"}) == ("task.tolerance: expected a number, got 'abc'")


def test_a_parameter_of_a_type_that_no_text_is(write_module):
    source = """
        from dataclasses import dataclass
        from rlctl.task import Task

        class Gripper:
            pass

        @dataclass
        class Grasp(Task):
            gripper: Gripper | None = None
        """
    write_module("grasp.py", source)
    assert error(RecipeError, "grasp.py:Grasp", {"gripper": "wide"}) == (
        "task.gripper: a value of type grasp.Gripper | None cannot be given here, only in Python"
    )


def test_what_only_tasks_have(my_env):
    assert error(RecipeError, "my_env.py:MyEnv", reward_weights={"a": 1.0}) == (
        "reward_weights: my_env.py:MyEnv is a plain Gymnasium environment; only tasks have them"
    )
    assert error(RecipeError, "my_env.py:MyEnv", events={"a": {}}).startswith("events: my_env.py:MyEnv is a plain")


def test_make_randomises_when_it_is_asked_to(my_env):
    import rlctl

    def acting(**options):
        env = rlctl.make("reach", **options)
        env.close()
        return set(env.unwrapped.events)

    assert acting() == set()
    assert acting(events={"mass": {"factor": (0.9, 1.1)}}) == {"mass"}
    assert acting(randomize=True) > {"mass"}
    with pytest.raises(RecipeError, match=r"^randomize: my_env\.py:MyEnv is a plain Gymnasium environment"):
        rlctl.make("my_env.py:MyEnv", randomize=True)


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("raise RuntimeError('no robot')", "import failed: RuntimeError: no robot (broken.py:1)"),
        ("raise SystemExit(0)", "import failed: SystemExit: 0 (broken.py:1)"),
        (
            "import nothing_like_it",
            "import failed: ModuleNotFoundError: No module named 'nothing_like_it' (broken.py:1)",
        ),
        ("x = = 1", "import failed: SyntaxError: invalid syntax (broken.py, line 1)"),
        (
            "class E:\n    def __init__(self): 1 / 0\n    reset = step = None",
            "ZeroDivisionError: division by zero (broken.py:2)",
        ),
    ],
)
def test_a_plugin_that_raises(write_module, source, message):
    write_module("broken.py", source)
    for _ in range(2):  # a half-imported module is not kept
        with pytest.raises(TaskError) as caught:
            EnvSpec("broken.py:E").make()
        assert str(caught.value) == f"task 'broken.py:E': {message}"
        assert ("Traceback" in caught.value.details) == ("SyntaxError" not in message)
        assert 'broken.py", line' in caught.value.details
        assert "importlib" not in caught.value.details
        assert caught.value.exit_code == 3


def test_hints_that_cannot_be_read(write_module):
    write_module(
        "late.py",
        """
        from __future__ import annotations
        from dataclasses import dataclass
        from rlctl.task import Task

        @dataclass
        class Late(Task):
            size: Missing = 1
        """,
    )
    assert error(TaskError, "late.py:Late", {"size": 2}).startswith(
        "task 'Late': NameError: name 'Missing' is not defined"
    )


def test_frames_are_stacked_oldest_first(my_env):
    env = EnvSpec("my_env.py:MyEnv", frame_stack=3).make()
    assert env.observation_space.shape == (6,)
    assert env.reset(seed=0)[0].tolist() == [0.0] * 6
    env.step(np.zeros(1))
    observation = env.step(np.zeros(1))[0]
    np.testing.assert_allclose(observation, [0, 0, 0.1, 0.1, 0.2, 0.2], atol=1e-7)
    assert error(RecipeError, "FrozenLake-v1", frame_stack=2).startswith("frame_stack: only flat and image observ")


def test_recipes_lie_beside_the_module(my_env, write_module):
    assert registry.find_recipe_file("my_env.py:MyEnv") is None
    recipe = write_module("my_env.yaml", "algo: sac")
    assert registry.find_recipe_file("my_env.py:MyEnv") == Path("my_env.yaml")
    assert registry.find_recipe_file("my_env:MyEnv") == recipe
    assert registry.find_recipe_file("reach").name == "reach.yaml"
    assert registry.find_recipe_file("rlctl_manipulation.reach:Reach") == registry.find_recipe_file("reach")
    assert registry.find_recipe_file("Pendulum-v1") is None
    assert registry.find_recipe_file("nothing") is None


def test_folder_names_of_tasks():
    names = {"reach": "reach", "a/b.py:MyEnv": "MyEnv", "pkg:ns/Env-v1": "ns-Env-v1", "x.py:../../..": "task"}
    assert {task: registry.make_slug(task) for task in names} == names


def test_where_a_task_comes_from():
    assert registry.find_origin("reach") == {"distribution": "rlctl", "version": rlctl.__version__}
    assert registry.find_origin("Pendulum-v1") == {}


@pytest.mark.parametrize("name", ["launch", "Launch"])
def test_what_is_no_environment_is_not_called(write_module, tmp_path, name):
    source = "def launch():\n    open('launched', 'w')\nclass Launch:\n    def __init__(self):\n        launch()\n"
    write_module("rocket.py", source)
    assert f"{name} is neither a Gymnasium environment" in error(TaskError, f"rocket.py:{name}")
    assert "getcwd is neither a Gymnasium environment" in error(TaskError, "os:getcwd")
    assert not (tmp_path / "launched").exists()


@pytest.mark.slow
def test_an_id_that_a_package_of_this_folder_registers(write_module):
    write_module("driving/__init__.py", "import gymnasium\ngymnasium.register(id='Driving-v0', entry_point=object)\n")
    write_module("driving/other.py", "print('Driving-v0', 'Parking-v0')\n")
    write_module(
        "src/parking/__init__.py", "import gymnasium\ngymnasium.register(id='Parking-v0', entry_point=object)\n"
    )
    driving = "driving registers Driving-v0, which Gymnasium cannot know: write driving:Driving-v0"
    assert error(UsageError, "Driving-v0") == driving
    # `src` is a folder of modules that can be imported, too.
    assert error(UsageError, "Parking-v0").endswith("write src.parking:Parking-v0")
    assert error(UsageError, "Flying-v0").endswith("If a package registers it, write PACKAGE:Flying-v0.")


def test_an_id_that_an_installed_package_registers(write_module, install, monkeypatch):
    folder = install("gym-crane", {}, {"gym_crane/__init__.py": "", "gym_crane/ids.py": "register('Crane-v3')\n"})
    (metadata,) = folder.glob("*.dist-info/METADATA")
    metadata.write_text(f"{metadata.read_text()}Requires-Dist: gymnasium>=0.29\n")
    monkeypatch.syspath_prepend(folder)
    (folder / "elsewhere").mkdir()
    monkeypatch.chdir(folder / "elsewhere")
    assert error(UsageError, "Crane-v3").endswith("write gym_crane:Crane-v3")
    # As gymnasium-robotics does: for each kind of reward another id.
    formatted = 'register(id=f"CraneReach{suffix}-v4")\nregister(id=f"{name}-v4")\n'
    (folder / "gym_crane/ids.py").write_text(formatted)
    assert error(UsageError, "CraneReachDense-v4").endswith("write gym_crane:CraneReachDense-v4")
    assert error(UsageError, "CraneReach-v4").endswith("write gym_crane:CraneReach-v4")
    assert "gym_crane" not in error(UsageError, "Lift-v4")


def test_an_installed_package_beside_the_folder_of_its_project(tmp_path, monkeypatch):
    """An editable installation is found by a finder of its own, after the folders of `sys.path`."""
    package = tmp_path / "mooring" / "mooring"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("def Rope(): pass\n")
    spec = spec_from_file_location("mooring", package / "__init__.py", submodule_search_locations=[str(package)])
    finder = SimpleNamespace(find_spec=lambda name, path, target=None: spec if name == "mooring" else None)
    monkeypatch.setattr("sys.meta_path", [*sys.meta_path, finder])
    monkeypatch.setattr("sys.path", [entry for entry in sys.path if entry not in ("", os.getcwd())])
    monkeypatch.chdir(tmp_path)
    assert registry.load("mooring:Rope").__name__ == "Rope"


def test_a_package_that_an_installed_one_hides(write_module):
    write_module("numpy/envs/__init__.py", ENV)
    message = error(UsageError, "numpy.envs:MyEnv")
    assert message.splitlines()[0].endswith("numpy/__init__.py hides numpy/ of this folder")
    assert message.splitlines()[1] == "put this folder first: PYTHONPATH=. rlctl ..."


def test_the_place_of_an_error_is_a_line_of_the_author(write_module):
    write_module("arms/__init__.py", "")
    write_module("arms/envs/__init__.py", "import numpy as np\n\ndef make():  # for gymnasium\n    np.zeros(-1)\n")
    write_module(
        "draws.py", "import numpy as np  # gym\n\ndef make():\n    np.random.default_rng(0).uniform(5, -np.inf)\n"
    )
    with pytest.raises(TaskError, match=r"\(arms/envs/__init__.py:4\)$"):
        EnvSpec("arms.envs:make").make()
    with pytest.raises(TaskError, match=r"\(draws.py:4\)$"):  # not the line of NumPy's _common.pyx
        EnvSpec("draws.py:make").make()


@pytest.mark.pybullet
def test_a_window_without_a_display_is_refused(write_module, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    write_module("window.py", "import pybullet as p  # gym\n\ndef make():\n    p.connect(p.GUI)\n")
    with pytest.raises(NoDisplayError) as caught:
        EnvSpec("window.py:make").make()
    first, second = str(caught.value).splitlines()
    assert first == "task 'window.py:make': PyBullet opens a window (p.GUI, window.py:4), and there is no display"
    assert second.startswith("write p.connect(p.GUI if render_mode ==")


def test_opengl_without_a_display_is_explained(write_module):
    error = "raise RuntimeError('an OpenGL platform library has not been loaded')"
    write_module("camera.py", f"def make():  # for gymnasium\n    {error}\n")
    with pytest.raises(TaskError, match=r"has not been loaded \(camera.py:2\)\nWhere there .* set MUJOCO_GL=egl"):
        EnvSpec("camera.py:make").make()


def test_a_function_whose_file_lacks_gymnasium(write_module):
    write_module("factory.py", "def make():\n    pass\n")
    with pytest.raises(TaskError, match=r"it was not called, .*\nwrite `import gymnasium` in that file$"):
        EnvSpec("factory.py:make").make()
