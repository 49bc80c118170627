"""What may import what, so that each part can be read, tested and started alone."""

import ast
import functools
import gc
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# From the top down: a module imports rooms of lines below its own, and its own room. There are no exceptions.
LAYERS = [
    {"__main__"},
    {"cli"},
    {"arguments"},
    {"__init__"},  # loads `rlctl.train` and the others on their first use
    {"pytest_plugin"},
    {"api", "gym"},
    {"cluster"},
    {"tuning"},
    {"launching"},
    {"training"},
    {"gating"},
    {"runs.report"},
    {"runs.compare"},
    {"exporting", "replaying", "tasks", "importing"},
    {"checking", "evaluation"},
    {"runs"},
    {"play"},
    {"deploy"},  # names of `limits` for Python programs
    {"limits"},
    {"processes"},
    {"policy"},
    {"recipe"},
    {"hub"},
    {"environments"},
    {"entry_points"},
    {"task"},
    {"library_output"},
    {"printed_lines"},
    {"output"},
    {"storage"},
    {"options"},
    {"engine"},
    {"errors", "version"},
    {"missing_packages"},
]
TORCH = {"torch", "stable_baselines3", "sb3_contrib"}
MAY_IMPORT_TORCH = {  # besides training/
    "rlctl/policy/torch_policy.py",
    "rlctl/policy/xqc.py",
}


@functools.cache
def parse(file: Path) -> ast.Module:
    tree = ast.parse(file.read_text())
    gc.freeze()  # trees stay: or collections would look through all of them for most of the time
    return tree


def walk_statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Yield statements and those inside of them; `ast.walk` takes seconds for all their expressions."""
    for node in body:
        yield node
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            yield from walk_statements(getattr(node, part, []))


@functools.cache
def imports(file: Path) -> set[str]:
    """Every module a file imports, anywhere in it: also in functions, and for types alone."""
    found = set()
    for node in walk_statements(parse(file).body):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def files(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def room_of(module: str) -> str:
    """`rlctl.play.episode` -> `play`; `rlctl.runs.report.show` -> `runs.report`; `rlctl.train` -> `__init__`."""
    parts = module.split(".")[1:]
    names = (".".join(parts[:2]), parts[0] if parts else "")
    return next((name for name in names if any(name in layer for layer in LAYERS)), "__init__")


def level(room: str) -> int:
    return next(number for number, layer in enumerate(LAYERS) if room in layer)


def module_of(file: Path) -> str:
    root = ROOT / "plugins" if file.is_relative_to(ROOT / "plugins") else ROOT
    return ".".join(file.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def test_every_room_has_a_layer():
    names = {path.stem if path.is_file() else path.name for path in (ROOT / "rlctl").iterdir()}
    assert {name for name in names - {"py", "__pycache__"} if not any(name in layer for layer in LAYERS)} == set()


def test_imports_run_downwards():
    wrong = []
    for file in files("rlctl"):
        room = room_of(module_of(file))
        for module in imports(file):
            other = room_of(module)
            downwards = other == room or level(other) > level(room)
            if module.startswith("rlctl_") or (module.split(".")[0] == "rlctl" and not downwards):
                wrong.append(f"{file.relative_to(ROOT)} imports {module}")
    assert wrong == []


def list_imported_modules(module: str, modules: dict[str, Path]) -> set[str]:
    names = {name if name in modules else name.rpartition(".")[0] for name in imports(modules[module])}
    return (names & set(modules)) - {module, "rlctl"}


def test_no_two_modules_import_each_other():
    modules = {module_of(file): file for folder in ("rlctl", "plugins") for file in files(folder)}
    left = {module: list_imported_modules(module, modules) for module in modules}
    while leaves := [module for module, others in left.items() if not others & set(left)]:
        for module in leaves:
            del left[module]
    while tops := set(left) - {other for others in left.values() for other in others}:  # only import a circle
        for module in tops:
            del left[module]
    assert left == {}


def test_a_class_name_means_one_thing():
    texts = [file.read_text() for file in files("rlctl")]
    names = [name for text in texts for name in re.findall(r"^ *class (\w+)[(:]", text, re.MULTILINE)]
    assert len(names) > 100
    assert {name for name in names if names.count(name) > 1} == set()


MAY_SHARE_A_NAME = {
    "rlctl/options.py: Checkpoint",  # an option of commands, as the user writes it
    "rlctl/recipe/network_parameters.py: Activation",  # a value of a recipe's key
    "rlctl/task/events/event.py: Steps",  # for task authors
    "rlctl/checking/experiments/batches.py: Rows",
    "rlctl/checking/drawn_goals.py: Source",
    "rlctl/checking/experiments/held.py: Rows",
    "rlctl/checking/kept_state.py: Observed",
    "rlctl/checking/rules/rl614_hindsight_reward_differs.py: Rows",
    "rlctl/checking/rules/rl816_command_beyond_ctrlrange.py: BulletJoint",
    "rlctl/environments/bullet_calls.py: Contacts",  # as PyBullet returns them
}


def list_aliases(file: Path) -> list[str]:
    """Return the names of a module that stand for types: `Array = NDArray[np.float64]`."""
    found = []
    for node in parse(file).body:
        if isinstance(node, ast.Assign) and not isinstance(node.value, ast.Call):
            names = [target.id for target in node.targets if isinstance(target, ast.Name)]
            found += [name for name in names if re.fullmatch(r"[A-Z]\w*[a-z]\w*", name)]
    return found


def test_an_alias_of_a_type_is_not_the_name_of_a_class():
    """`Rows` is a class of actors: indices of worlds, or rows of a table, have another name."""
    texts = [file.read_text() for file in files("rlctl")]
    classes = {name for text in texts for name in re.findall(r"^ *class (\w+)[(:]", text, re.MULTILINE)}
    aliases = {(str(file.relative_to(ROOT)), name) for file in files("rlctl") for name in list_aliases(file)}
    assert len(aliases) > 50
    shared = {f"{file}: {name}" for file, name in aliases if name in classes}
    assert shared - MAY_SHARE_A_NAME == set()


def test_who_imports_torch():
    found = [
        f"{name} imports {module}"
        for file in files("rlctl")
        if (name := str(file.relative_to(ROOT))) not in MAY_IMPORT_TORCH and not name.startswith("rlctl/training/")
        for module in imports(file)
        if module.split(".")[0] in TORCH
    ]
    assert found == []


OPEN_TO_COMMANDS = {
    *("arguments", "environments", "errors", "evaluation", "exporting.controller.plan"),
    *("exporting.controller.observation", "limits", "options", "output", "play", "policy", "processes", "replaying"),
    *("recipe", "runs", "storage", "task", "version"),
}
"""The rooms and modules that a plugin with commands may import; one with tasks imports `rlctl.task` alone."""


OF_RESULTS = ("runs.diagnosis", "runs.summary", "runs.report", "runs.compare", "replaying", "exporting")


def test_training_reaches_results_through_its_callbacks():
    forbidden = tuple(f"rlctl.{room}" for room in OF_RESULTS)
    wrong = [
        f"{file.relative_to(ROOT)} imports {module}"
        for file in files("rlctl/training")
        for module in imports(file)
        if module.startswith(forbidden)
    ]
    assert wrong == []


def find_imports_of_rlctl(plugin: str, allowed: set[str]) -> list[str]:
    beginnings = tuple(f"rlctl.{name}." for name in allowed)
    return [
        f"{file.relative_to(ROOT)} imports {module}"
        for file in files(plugin)
        for module in imports(file)
        if module.split(".")[0] == "rlctl" and not f"{module}.".startswith(beginnings)
    ]


def test_plugins_with_tasks_know_the_task_layer_only():
    plugins = {folder.name for folder in (ROOT / "plugins").iterdir() if any(folder.glob("*.py"))}
    assert plugins == {"rlctl_locomotion", "rlctl_manipulation", "rlctl_robot"}
    for plugin in plugins - {"rlctl_robot"}:
        assert find_imports_of_rlctl(f"plugins/{plugin}", {"task"}) == []


def test_plugins_with_commands_know_the_rooms_that_are_open_to_them():
    assert find_imports_of_rlctl("plugins/rlctl_robot", OPEN_TO_COMMANDS) == []
    page = (ROOT / "docs/own-commands.md").read_text()
    assert {name for name in OPEN_TO_COMMANDS if f"`rlctl.{name}`" not in page} == set()


def loaded_after(*lines: str) -> dict[str, set[str]]:
    """Run lines of Python in one fresh interpreter; return the packages that are loaded after each."""
    note = "print('@' + json.dumps(sorted({name.partition('.')[0] for name in sys.modules})), file=sys.stderr)"
    code = "\n".join(["import json, sys", *(f"{line}\n{note}" for line in lines)])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT.parent)
    found = [set(json.loads(line[1:])) for line in done.stderr.splitlines() if line.startswith("@")]
    return dict(zip(lines, found, strict=True))


HEAVY = {"numpy", "torch", "gymnasium", "pybullet", "rerun", "scipy", "stable_baselines3", "onnx", "onnxruntime"}


def test_what_must_start_at_once():
    commands = [["--help"], ["train", "--help"], ["tasks"], ["--version"]]
    loaded = loaded_after(
        "import rlctl",
        "from rlctl.cli import run",
        *(f"assert run({command}) == 0" for command in commands),
        "assert run(['evil']) == 2",
    )
    assert {line: modules & HEAVY for line, modules in loaded.items() if modules & HEAVY} == {}


@pytest.mark.slow
def test_environments_come_without_learning_libraries():
    loaded = loaded_after(
        "import rlctl; rlctl.make('reach').close()",
        "from rlctl.environments.spec import EnvSpec; EnvSpec('Pendulum-v1').make()",
        "from rlctl.play import collect, worker, workers",
        "from rlctl.deploy import SafetyFilter",
    )
    assert {line: modules & TORCH for line, modules in loaded.items() if modules & TORCH} == {}


def is_public_definition(node: ast.AST) -> bool:
    """A class, function or method without `_`; not an `@overload` or a setter, whose docstrings nobody shows."""
    if not isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) or node.name.startswith("_"):
        return False
    return not any(ast.unparse(mark).endswith(("overload", ".setter")) for mark in node.decorator_list)


OF_BOTH_ENGINES = {"Sim", "Body", "Constraints", "Motors", "Properties", "MujocoMotors", "MujocoSim"}
"""Classes whose subclasses give each engine's version of methods that `Sim` and `Body` document."""


def find_undocumented(body: list[ast.stmt], inherited: bool = False) -> list[str]:
    names = []
    for node in filter(is_public_definition, body):
        assert isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        names += [] if ast.get_docstring(node) or (inherited and node.name in documented_once()) else [node.name]
        if isinstance(node, ast.ClassDef):
            inherits = any(ast.unparse(base) in {*OF_BOTH_ENGINES, "Task"} for base in node.bases)
            names += [f"{node.name}.{name}" for name in find_undocumented(node.body, inherits)]
    return names


@functools.cache
def documented_once() -> set[str]:
    """The methods that `Sim`, `Body` and `Task` document for all their subclasses in rlctl."""
    trees = [ast.parse((ROOT / f"rlctl/task/{file}.py").read_text()) for file in ("sim", "body", "task")]
    classes = [node for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)]
    return {node.name for cls in classes for node in cls.body if isinstance(node, ast.FunctionDef)}


def test_the_check_of_docstrings_finds_what_lacks_one() -> None:
    source = "class A:\n  @x.setter\n  def x(self): pass\n  def y(self): pass\n  def _z(self): pass\ndef f(): pass"
    assert find_undocumented(ast.parse(source).body) == ["A", "A.y", "f"]


def test_every_public_class_function_and_method_has_a_docstring() -> None:
    undocumented = {
        str(file.relative_to(ROOT)): names for file in files("rlctl") if (names := find_undocumented(parse(file).body))
    }
    assert undocumented == {}
