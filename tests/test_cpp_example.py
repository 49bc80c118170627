"""The C++ example builds, and its loop acts as the policy does and holds without observations."""

import os
import shutil
import subprocess
import tarfile
import time
from pathlib import Path

import numpy as np
import pytest

import rlctl

EXAMPLE = Path(__file__).parent.parent / "examples" / "cpp"
# A plugin for Unity: of the packages of Python and Node the one with ONNX Runtime's C++ headers, and Linux's library.
NPM_PACKAGE = "com.github.asus4.onnxruntime@0.4.9"  # 150 MB; of ONNX Runtime 1.30
HEADERS, LIBRARY = "/ios-arm64/onnxruntime.framework/Headers/", "/Linux/x64/libonnxruntime.so"
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
    said = play(build(tmp_path, f"-DPOLICY_C={tmp_path / 'policy.c'}"))
    assert "period: 0.0166667 s" in said
    assert "joint_positions (7) [rad], joint_velocities (7) [rad/s]" in said
    assert "action: 7 elements: lbr_iiwa_joint_1 (-1 to 1), " in said


@pytest.fixture
def onnxruntime(request):
    """A folder with `include` and `lib`: $ONNXRUNTIME_DIR, or what npm gives, kept in pytest's cache."""
    if given := os.environ.get("ONNXRUNTIME_DIR"):
        return Path(given)
    folder = request.config.cache.mkdir("onnxruntime")
    if not (folder / "lib" / "libonnxruntime.so").exists():
        if shutil.which("npm") is None:
            pytest.skip("no ONNX Runtime for C++ here, and no npm to get it with: set ONNXRUNTIME_DIR")
        got = subprocess.run(["npm", "pack", NPM_PACKAGE], cwd=folder, capture_output=True, text=True, timeout=600)
        if got.returncode != 0:
            pytest.skip(f"{NPM_PACKAGE} cannot be had here: {got.stderr.splitlines()[-1:]}; set ONNXRUNTIME_DIR")
        unpack(folder / got.stdout.split()[-1], folder)
    return folder


def unpack(package, folder):
    """Take headers and library out of the package, and delete it."""
    for name in ("include", "lib"):
        (folder / name).mkdir(exist_ok=True)
    with tarfile.open(package) as archive:
        for member in archive:
            name = Path(member.name).name
            if HEADERS in member.name and name.endswith(".h"):
                (folder / "include" / name).write_bytes(archive.extractfile(member).read())
            elif member.name.endswith(LIBRARY):
                (folder / "lib" / "libonnxruntime.so.1").write_bytes(archive.extractfile(member).read())
    (folder / "lib" / "libonnxruntime.so").symlink_to("libonnxruntime.so.1")  # last: then it is whole
    package.unlink()


def test_loop_with_onnx_runtime(rlctl, tmp_path, onnxruntime):
    done = rlctl("export", "reach", "--pretrained", "--onnx", "-o", "policy.onnx", timeout=300)
    assert done.returncode == 0, done.stderr
    program = build(tmp_path, f"-DONNXRUNTIME_DIR={onnxruntime}")
    said = play(program, tmp_path / "policy.onnx")
    assert "joint_positions (7) [rad], joint_velocities (7) [rad/s]" in said
