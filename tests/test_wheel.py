"""The wheel, in a clean environment: what `pip install` gives a user, not what the checkout holds."""

import json
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def call(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run([str(part) for part in command], cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_wheel_trains_reach_from_an_empty_folder(tmp_path):
    call(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path / "dist", ROOT, cwd=tmp_path)
    (wheel,) = (tmp_path / "dist").glob("rlctl-*.whl")
    venv.create(tmp_path / "venv", with_pip=True)
    scripts = tmp_path / "venv" / "bin"
    call(scripts / "pip", "install", "-q", "-c", ROOT / "constraints.txt", wheel, cwd=tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    tasks = json.loads(call(scripts / "rlctl", "tasks", "--check", "--json", "-", cwd=empty))["tasks"]
    assert {(task["name"], task["algo"], task["problem"]) for task in tasks} == {
        *((name, "ppo", None) for name in ("reach", "reach-batch", "walk")),
        *((name, "tqc", None) for name in ("ant", "biped", "half-cheetah", "hopper", "humanoid", "walker2d")),
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
