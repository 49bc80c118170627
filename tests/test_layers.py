"""What may import what, so that each part can be read, tested and started alone."""

import ast
import functools
import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent

# From the top down; a module imports parts of lines below its own, and of its own part.
LAYERS = [
    {"__main__"},
    {"cli"},
    {"error_boundary", "completion", "python_api"},
    {"tune"},
    {"train"},
    {"export", "replay", "tasks", "runs"},
    {"check_env", "eval"},
    {"deploy"},
    {"rollout"},
    {"run"},
    {"gym"},
    {"env_spec"},
    {"dict_spaces", "time_feature"},
    {"time_limit"},
    {"named_task"},
    {"registry"},
    {"plugin_code"},
    {"task"},
    {"output"},
    {"joints"},
    {"errors", "__init__"},
]
# Beside the order above.
ALSO = {
    ("output", "run"),
    ("__init__", "env_spec"),
    ("__init__", "run"),
    ("__init__", "python_api"),
    ("train", "python_api"),
    ("rollout", "deploy"),  # a worker bounds its policy's actions by the filter that robots are behind
    ("runs", "replay"),  # a report has pictures
}
NOT_AMONG_VERBS = {("export", "check_env"), ("replay", "check_env"), ("replay", "export")}
TORCH = {"torch", "stable_baselines3", "sb3_contrib"}
MAY_IMPORT_TORCH = {  # besides train/
    "rlctl/run/torch_policy.py",
    "rlctl/eval/evaluate.py",  # seeds torch's generator where torch is there already
}


@functools.cache
def imports(file: Path) -> set[str]:
    """Every module a file imports, anywhere in it but under TYPE_CHECKING."""
    tree = ast.parse(file.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def files(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def part_of(module: str) -> str:
    """`rlctl.run.policy.x` -> `run`; `rlctl.__version__` -> `__init__`."""
    part = f"{module}.".split(".")[1]
    return part if any(part in layer for layer in LAYERS) else "__init__"


def level(part: str) -> int:
    return next(number for number, layer in enumerate(LAYERS) if part in layer)


def test_every_part_has_a_layer():
    parts = {path.stem if path.is_file() else path.name for path in (ROOT / "rlctl").iterdir()}
    assert {part for part in parts - {"py", "__pycache__"} if not any(part in layer for layer in LAYERS)} == set()


def test_imports_run_one_way():
    wrong = []
    for file in files("rlctl"):
        part = file.relative_to(ROOT / "rlctl").parts[0].removesuffix(".py")
        for module in imports(file):
            package, other = module.split(".")[0], part_of(module)
            if package.startswith("rlctl_") or (package == "rlctl" and not may_import(part, other)):
                wrong.append(f"{file.relative_to(ROOT)} imports {module}")
    assert wrong == []


def may_import(part: str, other: str) -> bool:
    return (
        other == part or (level(other) > level(part) and (part, other) not in NOT_AMONG_VERBS) or (part, other) in ALSO
    )


def test_who_imports_torch():
    found = [
        f"{name} imports {module}"
        for file in files("rlctl")
        if (name := str(file.relative_to(ROOT))) not in MAY_IMPORT_TORCH and not name.startswith("rlctl/train/")
        for module in imports(file)
        if module.split(".")[0] in TORCH
    ]
    assert found == []


def test_plugins_know_the_task_layer_only():
    wrong = [
        f"{file.relative_to(ROOT)} imports {module}"
        for file in files("plugins")
        for module in imports(file)
        if module.split(".")[0] == "rlctl" and not module.startswith("rlctl.task")
    ]
    assert wrong == []


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


def test_environments_come_without_learning_libraries():
    loaded = loaded_after(
        "import rlctl; rlctl.make('reach').close()",
        "from rlctl.env_spec import EnvSpec; EnvSpec('Pendulum-v1').make()",
        "from rlctl.rollout import collect, worker, workers",
        "from rlctl.deploy import SafetyFilter",
    )
    assert {line: modules & TORCH for line, modules in loaded.items() if modules & TORCH} == {}
