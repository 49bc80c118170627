"""What is declared, what is packed, and what CI caches."""

import importlib.metadata
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from hatchling.builders.sdist import SdistBuilder

from rlctl import errors
from rlctl.errors import explain_missing_package
from tests.test_layers import files, imports

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
OF_USERS = {"gym", "minari", "lerobot"}
"""What rlctl looks for in an environment's own imports and needs nothing of."""


def normalize(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_import_is_a_declared_dependency():
    extras = [line for lines in PROJECT["optional-dependencies"].values() for line in lines]
    declared = {normalize(re.match(r"[\w.-]+", line)[0]) for line in [*PROJECT["dependencies"], *extras]}
    provided = {package for name in declared for package in list_packages(name)}
    undeclared = set()
    for name in set().union(*(imports(file) for folder in ("rlctl", "plugins") for file in files(folder))):
        top = name.partition(".")[0]
        of_rlctl = top in ("rlctl", "rlctl_manipulation", "rlctl_locomotion", "rlctl_robot")
        if of_rlctl or top in sys.stdlib_module_names or top in OF_USERS:
            continue
        if top not in provided or (top == "google" and not name.startswith("google.protobuf")):
            undeclared.add(name)
    assert undeclared == set()


def list_packages(name: str) -> set[str]:
    """Return the importable names of an installed distribution; none of one that is not installed."""
    try:
        distribution = importlib.metadata.distribution(name)
    except importlib.metadata.PackageNotFoundError:
        return set()
    record = distribution.read_text("RECORD") or ""  # `distribution.files` looks at each file, of thousands
    paths = [line.partition(",")[0] for line in record.splitlines()]
    return {path.partition("/")[0].removesuffix(".py") for path in paths}


def test_no_folder_of_the_sdist_has_a_readme_alone():
    packed = [Path(file.relative_path) for file in SdistBuilder(str(ROOT)).recurse_included_files()]
    assert {"README.md", "CHANGELOG.md", "constraints.txt", "docs/run.md", "examples/my_task/pyproject.toml"} <= {
        path.as_posix() for path in packed
    }
    folders = {path.parent for path in packed if path.name == "README.md"} - {Path()}
    full = {path.parent for path in packed if path.suffix != ".md"}
    assert {folder for folder in folders if not any(place.is_relative_to(folder) for place in full)} == set()


@pytest.mark.parametrize(
    "file",
    [".github/workflows/ci.yml", ".github/workflows/nightly.yml", "examples/ci/rlctl.yml", "examples/ci/check-env.yml"],
)
def test_what_pins_the_packages_is_in_the_key_of_the_cache(file):
    workflow = yaml.safe_load((ROOT / file).read_text())
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    caches = [step["with"] for step in steps if "setup-python" in step.get("uses", "")]
    assert caches
    for cache in caches:
        assert "constraints.txt" in cache["cache-dependency-path"]
        assert "pyproject.toml" in cache["cache-dependency-path"]


def test_the_extra_with_a_missing_package_is_named(monkeypatch):
    expected = "rlctl serve needs aiohttp: pip install '{}[serve]'"
    assert explain_missing_package("rlctl serve", "aiohttp", "serve") == expected.format("rlctl")
    monkeypatch.setattr(errors, "_read_requirements", {"rlctl-core": []}.get)
    assert explain_missing_package("rlctl serve", "aiohttp", "serve") == expected.format("rlctl-core")


def make_environment(folder: Path, target: str = "bin/python", **programs: str) -> subprocess.CompletedProcess[str]:
    """Run a rule for a file in `.venv`, where nothing but the shell and these programs is found."""
    tools = folder / "bin"
    tools.mkdir()
    for name in ("sh", "mkdir", "cat", "chmod", "touch"):
        (tools / name).symlink_to(shutil.which(name))
    for name, script in programs.items():
        (tools / name).write_text(f"#!/bin/sh\n{script}\n")
        (tools / name).chmod(0o755)
    command = [shutil.which("make"), "-f", ROOT / "Makefile", f".venv/{target}", "SHELL=/bin/sh"]
    return subprocess.run(command, cwd=folder, env={"PATH": str(tools)}, capture_output=True, text=True, check=False)


INSTALL = """mkdir -p .venv/bin
cat > .venv/bin/pip <<'END'
#!/bin/sh
echo "pip $@"
END
chmod +x .venv/bin/pip"""


def test_make_says_what_is_missing(tmp_path):
    done = make_environment(tmp_path)
    assert done.returncode == 2
    assert done.stdout == (
        "no Python from 3.11 to 3.14 found: install one, or uv (https://docs.astral.sh/uv), and run make again\n"
    )


def test_make_uses_uv_where_python_is_missing(tmp_path):
    done = make_environment(tmp_path, uv=f'echo "uv $@"; {INSTALL}')
    assert done.returncode == 0, done.stderr
    first, size = done.stdout.splitlines()
    assert first == "uv venv --quiet --seed --python 3.11 .venv"
    assert size.startswith("installing into .venv: up to 2.2 GB, of which PyTorch for the CPU 0.7, Rerun 0.7,")


PYTHON = f"""case "$1" in
  -c) case "$2" in *version*) exit 1;; *) echo "$0";; esac;;
  *) echo "$0 $@"; {INSTALL};;
esac"""


@pytest.mark.parametrize(
    ("found", "used"),
    [(["3.11", "3.14"], "3.11"), (["3.12", "3.13"], "3.13"), (["3.12", "3.14"], "3.14")],
)
def test_make_prefers_the_python_that_has_both_engines_then_the_newest(tmp_path, found, used):
    done = make_environment(tmp_path, **{f"python{version}": PYTHON for version in found})
    assert done.returncode == 0, done.stderr
    assert f"/bin/python{used} -m venv .venv" in done.stdout


def test_make_says_what_a_python_without_pybullet_does(tmp_path):
    done = make_environment(tmp_path, **{"python3.13": PYTHON})
    assert done.stdout.startswith("PyBullet has no wheels for Python 3.12 and newer: tasks are simulated in MuJoCo.")


def test_make_installs_with_uv_if_it_is_there(tmp_path):
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    done = make_environment(tmp_path, ".installed", uv=f'echo "uv $@"; {INSTALL}')
    assert done.returncode == 0, done.stderr
    assert "uv pip install --quiet --python .venv/bin/python -c constraints.txt -e .\n" in done.stdout
