"""The C++ example builds, and its loop acts as the policy does and holds without observations."""

import os
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

import rlctl

EXAMPLE = Path(__file__).parent.parent / "examples" / "cpp"
HEADERS = [
    Path(folder) / "onnxruntime_cxx_api.h"
    for folder in (os.environ.get("ONNXRUNTIME_DIR", "") + "/include", "/usr/include/onnxruntime", "/usr/local/include")
]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cmake") is None or shutil.which("c++") is None, reason="no cmake or no compiler"),
]


def build(folder, *options):
    for command in (["cmake", "-S", EXAMPLE, "-B", folder / "build", *options], ["cmake", "--build", folder / "build"]):
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "warning" not in done.stderr
    return folder / "build" / "policy_loop"


def play(program, *arguments):
    """Send observations in time, then one that is not finite, then nothing; compare the actions and the holding."""
    policy = rlctl.load_policy("reach")
    observation = np.random.default_rng(0).uniform(-0.5, 0.5, 20).astype(np.float32)
    process = subprocess.Popen(
        [program, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    line = " ".join(map(str, observation.tolist()))
    for _ in range(20):
        process.stdin.write(f"{line}\n")
        process.stdin.flush()
        time.sleep(1 / 60)
    process.stdin.write(f"{line.rpartition(' ')[0]} nan\n")
    printed, said = process.communicate(timeout=30)
    assert process.returncode == 0, said
    lines = printed.splitlines()
    actions = [np.array(each.split(), np.float32) for each in lines if each != "hold"]
    assert len(actions) >= 3
    for action in actions:
        assert action == pytest.approx(policy.predict(observation), abs=1e-5)
    assert lines[-1] == "hold"
    assert "observation: 20 elements" in said
    return said


def test_loop_with_the_c_function(rlctl, tmp_path):
    done = rlctl("export", "reach", "--pretrained", "--c", "-o", "policy.c", timeout=300)
    assert done.returncode == 0, done.stderr
    assert "period: 0.0166667 s" in play(build(tmp_path, f"-DPOLICY_C={tmp_path / 'policy.c'}"))


@pytest.mark.skipif(not any(map(Path.is_file, HEADERS)), reason="no ONNX Runtime for C++ here: set ONNXRUNTIME_DIR")
def test_loop_with_onnx_runtime(rlctl, tmp_path):
    done = rlctl("export", "reach", "--pretrained", "--onnx", "-o", "policy.onnx", timeout=300)
    assert done.returncode == 0, done.stderr
    program = build(tmp_path, f"-DONNXRUNTIME_DIR={os.environ.get('ONNXRUNTIME_DIR', '/usr')}")
    said = play(program, tmp_path / "policy.onnx")
    assert "joint_positions (7), joint_velocities (7)" in said
