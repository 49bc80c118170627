"""What may import what, so that each part can be read, tested and started alone."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# From the top down; a module imports parts of lines below its own, and of its own part.
LAYERS = [
    {"__main__"},
    {"cli"},
    {"train"},
    {"export", "replay", "tasks"},
    {"check_env", "eval"},
    {"rollout"},
    {"run"},
    {"gym"},
    {"env_spec"},
    {"named_task"},
    {"registry"},
    {"task"},
    {"output"},
    {"errors", "__init__"},
]
# Beside the order above.
ALSO = {("output", "run"), ("__init__", "env_spec"), ("__init__", "run")}
NOT_AMONG_VERBS = {("export", "check_env"), ("replay", "check_env"), ("replay", "export")}
TORCH = {"torch", "stable_baselines3", "sb3_contrib"}
MAY_IMPORT_TORCH = {  # besides train/
    "rlctl/run/torch_policy.py",
    "rlctl/check_env/studies/library_checkers.py",  # SB3's own checker, which is a finding's source
    "rlctl/eval/evaluate.py",  # seeds torch's generator where torch is there already
}


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


@pytest.mark.parametrize("file", files("rlctl"), ids=lambda file: str(file.relative_to(ROOT)))
def test_imports_run_one_way(file):
    relative = file.relative_to(ROOT / "rlctl")
    part = relative.parts[0].removesuffix(".py")
    for module in imports(file):
        assert not module.startswith("rlctl_"), "a plugin"
        if module.split(".")[0] != "rlctl":
            continue
        other = part_of(module)
        allowed = other == part or level(other) > level(part) or (part, other) in ALSO
        assert allowed, f"{part} imports {module}"
        assert (part, other) not in NOT_AMONG_VERBS, f"{part} imports {module}"


@pytest.mark.parametrize("file", files("rlctl"), ids=lambda file: str(file.relative_to(ROOT)))
def test_who_imports_torch(file):
    name = str(file.relative_to(ROOT))
    if name in MAY_IMPORT_TORCH or name.startswith("rlctl/train/"):
        return
    used = {module.split(".")[0] for module in imports(file)} & TORCH
    assert not used, f"{name} imports {used}"


@pytest.mark.parametrize("file", files("plugins"), ids=lambda file: str(file.relative_to(ROOT)))
def test_plugins_know_the_task_layer_only(file):
    for module in imports(file):
        assert module.split(".")[0] != "rlctl" or module.startswith("rlctl.task"), module


def loaded_after(code: str) -> set[str]:
    told = subprocess.run(
        [
            sys.executable,
            "-c",
            f"{code}\nimport json, sys; print('\\n' + json.dumps(list(sys.modules)), file=sys.stderr)",
        ],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT.parent,
    )
    return {name.partition(".")[0] for name in json.loads(told.stderr.splitlines()[-1])}


HEAVY = {"numpy", "torch", "gymnasium", "pybullet", "rerun", "scipy", "stable_baselines3", "onnx", "onnxruntime"}


@pytest.mark.parametrize(
    "code",
    [
        "import rlctl",
        "from rlctl.cli import run; assert run(['--help']) == 0",
        "from rlctl.cli import run; assert run(['train', '--help']) == 0",
        "from rlctl.cli import run; assert run(['tasks']) == 0",
        "from rlctl.cli import run; assert run(['--version']) == 0",
        "from rlctl.cli import run; assert run(['evil']) == 2",
    ],
)
def test_what_must_start_at_once(code):
    assert not loaded_after(code) & HEAVY


def test_environments_come_without_learning_libraries():
    assert not loaded_after("import rlctl; rlctl.make('reach').close()") & TORCH
    assert not loaded_after("from rlctl.rollout import collect, workers, worker_process") & TORCH
    assert not loaded_after("from rlctl.env_spec import EnvSpec; EnvSpec('Pendulum-v1').make()") & TORCH
