"""The C++ example builds, and its loop commands what the policy does and holds without measurements."""

import os
import shutil
import subprocess
import tarfile
import time
from pathlib import Path

import numpy as np
import pytest
import sb3_contrib

import rlctl
from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.exporting.controller.graph import build_graph
from rlctl.exporting.controller.source import ControllerSource
from rlctl.policy.onnx_policy import encode
from rlctl.training.snapshot import pack
from tests.exporting.controllers import plan_of

EXAMPLE = Path(__file__).parent.parent / "examples" / "cpp"
# A plugin for Unity: of the packages of Python and Node the one with ONNX Runtime's C++ headers, and Linux's library.
NPM_PACKAGE = "com.github.asus4.onnxruntime@0.4.9"  # 150 MB; of ONNX Runtime 1.30
HEADERS, LIBRARY = "/ios-arm64/onnxruntime.framework/Headers/", "/Linux/x64/libonnxruntime.so"
pytestmark = [
    pytest.mark.pybullet,
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
    """Send measurements in time, then one that is not finite, then none; return the lines and what was said."""
    numbers = np.random.default_rng(0).uniform(-0.5, 0.5, 20).astype(np.float32)
    process = subprocess.Popen(
        [program, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    line = " ".join(map(str, numbers.tolist()))
    for _ in range(20):
        process.stdin.write(f"{line}\n")
        process.stdin.flush()
        time.sleep(1 / 60)
    process.stdin.write(f"{line.rpartition(' ')[0]} nan\n")
    printed, said = process.communicate(timeout=30)
    assert process.returncode == 0, said
    for text in (
        "inputs: 20 numbers: joint_positions (7) [rad], joint_velocities (7) [rad/s], hand (3) [m], goal (3) [m]",
        "of lbr_iiwa_joint_1, lbr_iiwa_joint_2",
        "period: 0.0166667 s",
    ):
        assert text in said
    return numbers, printed.splitlines()


def check_commands(policy, numbers, lines):
    """Every command is the target of the policy's next action; the last one is held."""
    joints, hand, goal = numbers[:7], numbers[14:17], numbers[17:]
    observation = np.concatenate([numbers[:17], goal.astype(float) - hand]).astype(np.float32)
    steps = policy.info.env.joints.action_step
    commands = [np.array(line.split()[1:], float) for line in lines if line.startswith("running")]
    assert len(commands) >= 3
    for command in commands:
        action = policy.predict(observation)
        assert command == pytest.approx(joints + np.array(steps) * action, abs=1e-6)
    assert lines[-1].startswith("holding")


def describe_reach():
    env = rlctl.make("reach")
    info = describe(env)
    env.close()
    return info


def make_recurrent(folder):
    """An untrained policy with an LSTM for reach, as a file and as a policy."""
    spec = EnvSpec("reach")
    env = spec.make()
    model = sb3_contrib.RecurrentPPO("MlpLstmPolicy", env, seed=0, policy_kwargs={"lstm_hidden_size": 16})
    file = pack(model, "recurrent_ppo", spec, describe(env))
    file.write(folder / "recurrent.safetensors")
    env.close()
    return file, rlctl.load_policy(str(folder / "recurrent.safetensors"))


def load_reach():
    policy = rlctl.load_policy("reach")
    policy.info = policy.info.model_copy(update={"env": describe_reach()})  # the shipped file is older than its steps
    return policy


def test_loop_with_c(rlctl, tmp_path):
    done = rlctl("export", "reach", "--pretrained", "--controller", "--c", "-o", "controller.c", timeout=300)
    assert done.returncode == 0, done.stderr
    check_commands(load_reach(), *play(build(tmp_path, f"-DCONTROLLER_C={tmp_path / 'controller.c'}")))


def test_loop_with_a_recurrent_policy_in_c(tmp_path):
    file, policy = make_recurrent(tmp_path)
    code = ControllerSource(file, plan_of(file), "controller", None).write()
    (tmp_path / "controller.c").write_text(code.source)
    (tmp_path / "controller.h").write_text(code.header)
    check_commands(policy, *play(build(tmp_path, f"-DCONTROLLER_C={tmp_path / 'controller.c'}")))


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
    done = rlctl("export", "reach", "--pretrained", "--controller", "--onnx", "-o", "controller.onnx", timeout=300)
    assert done.returncode == 0, done.stderr
    program = build(tmp_path, f"-DONNXRUNTIME_DIR={onnxruntime}")
    check_commands(load_reach(), *play(program, tmp_path / "controller.onnx"))
    file, policy = make_recurrent(tmp_path)
    (tmp_path / "recurrent.onnx").write_bytes(encode(build_graph(file, plan_of(file))))
    check_commands(policy, *play(program, tmp_path / "recurrent.onnx"))
