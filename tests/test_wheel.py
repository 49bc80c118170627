"""The wheels, in a clean environment: what `pip install` gives a user, not what the checkout holds."""

import json
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

from rlctl.version import __version__

ROOT = Path(__file__).parent.parent


def call(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run([str(part) for part in command], cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    """Paths of the wheels rlctl-core and rlctl."""
    folder = tmp_path_factory.mktemp("dist")
    return call(sys.executable, ROOT / ".ci" / "wheels.py", folder, f"v{__version__}", cwd=folder).split()


def install(folder: Path, *requirements: str) -> Path:
    """Return the folder of the scripts of a new virtual environment."""
    venv.create(folder / "venv", with_pip=True)
    scripts = folder / "venv" / "bin"
    call(scripts / "pip", "install", "-q", "--no-compile", "-c", ROOT / "constraints.txt", *requirements, cwd=folder)
    return scripts


def test_another_tag_is_refused(tmp_path):
    command = [sys.executable, str(ROOT / ".ci" / "wheels.py"), str(tmp_path), "v99.0"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith(f"the tag is v99.0, but rlctl/version.py has {__version__}")


def test_the_wheels_share_the_files_and_the_dependencies(wheels):
    core, whole = (zipfile.ZipFile(path) for path in wheels)
    assert {name for name in whole.namelist() if ".dist-info/" not in name} == set()
    assert {"rlctl/cli/__init__.py", "rlctl_manipulation/reach.py", "rlctl_robot/serve/page.html"} <= set(
        core.namelist()
    )
    small, rest = (
        {line for line in read_metadata(archive) if line.startswith("Requires-Dist") and "extra ==" not in line}
        for archive in (core, whole)
    )
    assert f"Requires-Dist: rlctl-core=={__version__}" in rest
    assert not small & rest
    assert {line.split()[1].rstrip("<>=0123456789.,") for line in small} >= {"numpy", "gymnasium", "typer"}
    assert not any(heavy in line for line in small for heavy in ("torch", "stable", "rerun", "tensorboard", "scipy"))


def read_metadata(archive: zipfile.ZipFile, file: str = "METADATA") -> list[str]:
    (name,) = [name for name in archive.namelist() if name.endswith(f".dist-info/{file}")]
    return archive.read(name).decode().splitlines()


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("extra", "task"), [("mujoco", "HalfCheetah-v5"), ("pybullet", "reach")])
def test_the_core_checks_environments_in_400_megabytes(wheels, tmp_path, extra, task):
    scripts = install(tmp_path, f"{wheels[0]}[{extra}]")
    assert sum(path.stat().st_size for path in (tmp_path / "venv").rglob("*") if path.is_file()) < 400e6
    call(scripts / "rlctl", "check-env", task, cwd=tmp_path)
    done = subprocess.run([scripts / "rlctl", "train", task], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.endswith("error: this needs torch, which is not part of rlctl-core: pip install rlctl\n")


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_core_evaluates_and_serves_an_exported_policy(wheels, tmp_path):
    policy = tmp_path / "reach.onnx"
    call(sys.executable, "-m", "rlctl", "export", "reach-batch", "--pretrained", "--onnx", "-o", policy, cwd=tmp_path)
    scripts = install(tmp_path, f"{wheels[0]}[mujoco,eval,serve]")
    call(scripts / "rlctl", "eval", policy, "--task", "reach-batch", "--min-success", "0.9", cwd=tmp_path)
    call(scripts / "rlctl", "serve", policy, "--self-test", cwd=tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_wheels_train_reach_from_an_empty_folder(wheels, tmp_path):
    scripts = install(tmp_path, *wheels)
    empty = tmp_path / "empty"
    empty.mkdir()
    tasks = json.loads(call(scripts / "rlctl", "tasks", "--check", "--json", "-", cwd=empty))["tasks"]
    assert {(task["name"], task["algo"], task["problem"]) for task in tasks} == {
        *((name, "ppo", None) for name in ("reach", "reach-batch", "pick", "place")),
        *(
            (name, "ppo", None)
            for name in ("walk", "walk-rough", "walk-stairs", "get-up", "humanoid-walk", "mini-walk", "humanoid-bow")
        ),
        *((name, "tqc", None) for name in ("ant", "biped", "half-cheetah", "hopper", "humanoid", "walker2d")),
        ("quadruped-bow", "ppo", None),
        *((name, "sac", None) for name in ("biped-3d", "quadruped", "reach-sparse")),
        *((name, "sac", None) for name in ("kuka-grasp", "gear-arm", "peg-insert", "screw-drive")),
    }
    for task in tasks:  # with its models
        call(scripts / "rlctl", "check-env", task["name"], "--select", "RL001,RL002,RL301", cwd=empty)
    result = json.loads(call(scripts / "rlctl", "train", "reach", "-n", "8000", "--json", "-", cwd=empty))
    assert result["steps"] >= 8000
    report = json.loads(call(scripts / "rlctl", "export", "reach", "--onnx", "--json", "-", cwd=empty))
    assert Path(empty, report["path"]).is_file()
    call(scripts / "rlctl", "eval", "reach", "--pretrained", "--episodes", "5", "--min-success", "1", cwd=empty)
    call(scripts / "rlctl", "replay", "reach", cwd=empty)
    assert list(empty.glob("runs/reach/*/episodes/*.rrd"))
