"""The C function does what the policy does, compiled with every warning."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest
from gymnasium import spaces

from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo, UsageError
from rlctl.exporting.c_source import FLAGS, build_library, find_compiler, write_c
from rlctl.exporting.export import export_policy
from rlctl.exporting.export_request import ExportRequest
from rlctl.policy.c_policy import CActor
from rlctl.policy.file import PolicyFile
from rlctl.policy.policy import Policy
from rlctl.policy.torch_policy import ACTIVATIONS, TorchActor
from rlctl.task.joints import Joints
from tests.exporting.test_export_graph import random_observations

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler (cc, or $CC) on this machine")
STEPS = 30


def write_source(path, name="policy"):
    policy = PolicyFile.read(path)
    return policy.info, write_c(policy, name)


@pytest.fixture
def compiled(tmp_path):
    """Compile a policy file, warnings are errors, and return the policy."""

    def compile_policy(path):
        info, code = write_source(path)
        return Policy(CActor.load(build_library(code, info, tmp_path, [*find_compiler(), "-Werror"])))

    return compile_policy


def difference(path, policy):
    """Largest difference between the policy file and C over an episode of random observations."""
    torch_policy = Policy(TorchActor.load(path))
    space = torch_policy.observation_space
    stacked = torch_policy.info.spec.frame_stack
    observations = random_observations(space, STEPS)
    if stacked > 1:
        size = space.shape[0] // stacked
        frames = [observations[0][:size]] * (stacked - 1) + [row[:size] for row in observations]
        observations = np.stack([np.concatenate(frames[step : step + stacked]) for step in range(STEPS)])
    worst = 0.0
    for _ in range(2):  # the second episode starts as the first
        torch_policy.reset()
        policy.reset()
        for step in range(STEPS):
            row = {key: part[step] for key, part in observations.items()} if isinstance(space, spaces.Dict) else None
            row = observations[step] if row is None else row
            expected, got = torch_policy.predict(row), policy.predict(row)
            assert got.shape == expected.shape
            assert got.dtype == expected.dtype or not isinstance(torch_policy.action_space, spaces.Box)
            worst = max(worst, float(np.abs(got.astype(float) - expected).max()))
    return worst


CASES = [
    ("ppo", "vector", "box", {}),
    ("ppo", "vector", "box", {"use_sde": True, "policy_kwargs": {"squash_output": True, "net_arch": [16, 16]}}),
    ("ppo", "multidiscrete", "multidiscrete", {}),
    ("ppo", "parts", "wide", {}),
    ("sac", "vector", "matrix", {"use_sde": True}),
    ("td3", "double", "double", {}),
    ("crossq", "vector", "box", {}),
    ("dqn", "vector", "discrete", {}),
    ("recurrent_ppo", "vector", "box", {"policy_kwargs": {"lstm_hidden_size": 8, "n_lstm_layers": 2}}),
]
SLOW_CASES = [
    ("a2c", "discrete", "discrete", {}),
    ("a2c", "multibinary", "multibinary", {}),
    ("ddpg", "vector", "box", {}),
    ("tqc", "vector", "box", {}),
    ("xqc", "vector", "box", {}),
    ("recurrent_ppo", "vector", "discrete", {"policy_kwargs": {"lstm_hidden_size": 8}}),
    *(
        ("ppo", "vector", "box", {"policy_kwargs": {"activation_fn": activation}})
        for activation in ACTIVATIONS.values()
    ),
]


@pytest.mark.slow_except(
    "ppo-vector-box-settings0", "dqn-vector-discrete-settings7", "recurrent_ppo-vector-box-settings8"
)
@needs_compiler
@pytest.mark.parametrize(
    ("algo", "observation", "action", "settings"),
    [*CASES, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW_CASES)],
)
def test_c_acts_as_the_policy(algo, observation, action, settings, small, train, write, compiled):
    spec = small(observation, action)
    path = write(train(algo, spec, steps=0, **settings), algo, spec)
    worst = difference(path, compiled(path))
    assert worst <= (1e-2 if action == "wide" else 1e-5)


@pytest.mark.slow
@needs_compiler
def test_hard_normalisation(small, train, write, compiled, odd_statistics):
    model = train("ppo", small(), steps=0)
    odd_statistics(model)
    path = write(model, "ppo", small())
    assert difference(path, compiled(path)) <= 1e-5


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(("algo", "frames"), [("ppo", 3), pytest.param("recurrent_ppo", 1, marks=pytest.mark.slow)])
def test_export_is_verified(algo, frames, small, train, write, tmp_path):
    small_spec = small()
    spec = EnvSpec(small_spec.task, small_spec.parameters, frame_stack=frames)
    path = write(train(algo, spec, steps=0), algo, spec)
    onnx, report = export_policy(ExportRequest(str(path), ("onnx", "c"), "best", None))
    assert (onnx.path, report.path) == (path.with_suffix(".onnx"), path.with_suffix(".c"))
    assert report.agreement.observations >= 2000
    assert report.agreement.agrees
    assert report.closed_loop.agrees
    assert not report.not_verified
    assert report.size == report.path.stat().st_size + report.details["header"].stat().st_size
    assert report.as_json()["verified"] is True
    assert report.latency.exported_us > 0  # a fifth of ONNX Runtime's or less, on an idle machine
    assert "policy_state *state" in report.details["prototype"]
    header = report.details["header"].read_text()
    assert "#define POLICY_OBSERVATION_SIZE 3" in header
    assert ("frames[9]" in header) == (frames == 3)


@pytest.mark.slow
@needs_compiler
def test_an_environment_that_does_not_repeat_its_episodes_is_verified_by_actions(small, train, write):
    spec = small(keeps=True)
    (report,) = export_policy(ExportRequest(str(write(train("ppo", spec, steps=0), "ppo", spec)), ("c",), "best", None))
    assert report.path.is_file()
    assert report.as_json()["verified"] is True
    assert not report.closed_loop.repeats


def test_without_a_compiler_it_is_not_verified(small, train, write, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    path = write(train("ppo", small(), steps=0), "ppo", small())
    (report,) = export_policy(ExportRequest(str(path), ("c",), "best", path.with_name("my policy-2.c")))
    assert report.path.is_file()
    assert report.details["header"].name == "my_policy_2.h"
    assert report.as_json()["verified"] is False
    assert ("not verified", "there is no C compiler 'no-such-compiler'; set CC to one") in report.list_rows()
    with pytest.raises(AnswerIsNo, match=r"my policy-2\.c: not verified: there is no C compiler"):
        report.check()


def test_images_are_refused(small, train, write):
    with pytest.raises(
        UsageError, match=r"^export --c: networks for images cannot be written as C; use export --onnx$"
    ):
        write_source(write(train("ppo", small("image"), steps=0), "ppo", small("image")))


@pytest.mark.slow
def test_what_c_cannot_carry_is_refused_on_the_command_line(rlctl, small, train, write, tmp_path):
    path = write(train("ppo", small("image"), steps=0), "ppo", small("image"))
    done = rlctl("export", path.name, "--c", "--onnx", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "error: export --c: networks for images cannot be written as C; use export --onnx\n"
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_name_of_the_output(small, train, write, tmp_path):
    path = write(train("ppo", small(), steps=0), "ppo", small())
    with pytest.raises(UsageError, match=r"give a name that ends in \.c"):
        export_policy(ExportRequest(str(path), ("c",), "best", tmp_path / "policy.onnx"))


@needs_compiler
def test_names_of_a_stranger_stay_in_their_comments(small, train, write, tmp_path):
    model = train("ppo", small(), steps=0)
    path = write(model, "ppo", small())
    policy = PolicyFile.read(path)
    evil = '*/ #error "out"\n#error "line" /* \\'
    env = policy.info.env.model_copy(update={"action_meaning": evil, "robot": evil, "observation_sizes": {evil: 3}})
    policy = policy.with_info(env=env)
    code = write_c(policy, "int")
    assert code.name == "int"
    library = build_library(code, policy.info, tmp_path, [*find_compiler(), "-Werror"])
    assert read_texts(library, "int_observation_names", 1) == [evil]


def read_texts(library, name, count):
    return [text.decode() for text in (ctypes.c_char_p * count).in_dll(ctypes.CDLL(str(library)), name)]


def read_numbers(library, name, count, kind=ctypes.c_float):
    return list((kind * count).in_dll(ctypes.CDLL(str(library)), name))


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("frames", [1, 3])
def test_names_bounds_and_units_are_data(frames, small, train, write, tmp_path):
    spec = EnvSpec(small().task, small().parameters, frame_stack=frames)
    policy = PolicyFile.read(write(train("ppo", spec, steps=0), "ppo", spec))
    joints = Joints(names=("elbow ??/", "\u00fcber"))
    env = {"observation_sizes": {"angle": 1, "speed": 2}, "observation_units": {"speed": "m/s"}, "joints": joints}
    policy = policy.with_info(env=policy.info.env.model_copy(update=env))
    code = write_c(policy, "policy")
    library = build_library(code, policy.info, tmp_path, [*find_compiler(), "-Werror"])
    assert "extern const char *const policy_action_names[POLICY_ACTION_SIZE];" in code.header
    assert "#define POLICY_OBSERVATION_PARTS 2" in code.header
    assert read_texts(library, "policy_observation_names", 2) == ["angle", "speed"]
    assert read_texts(library, "policy_observation_units", 2) == ["", "m/s"]
    assert read_numbers(library, "policy_observation_sizes", 2, ctypes.c_int) == [1, 2]
    assert read_numbers(library, "policy_observation_low", 3) == [-np.inf] * 3
    assert read_texts(library, "policy_action_names", 2) == ["elbow ??/", "\u00fcber"]
    assert read_numbers(library, "policy_action_low", 2) == [-2.0, -0.5]
    assert read_numbers(library, "policy_action_high", 2) == [1.0, 3.0]


@pytest.mark.slow
@needs_compiler
def test_choices_are_data(small, train, write, tmp_path):
    spec = small("parts", "multidiscrete")
    info, code = write_source(write(train("ppo", spec, steps=0), "ppo", spec))
    library = build_library(code, info, tmp_path, [*find_compiler(), "-Werror"])
    assert read_texts(library, "policy_observation_names", 3) == ["joints", "mode", "switch"]
    assert read_numbers(library, "policy_observation_high", 6) == [np.inf] * 3 + [4, 1, 1]
    assert read_texts(library, "policy_action_names", 3) == ["action[0]", "action[1]", "action[2]"]
    assert read_numbers(library, "policy_action_high", 3, ctypes.c_int) == [1, 2, 3]


@needs_compiler
def test_header_is_for_c_plus_plus_too(small, train, write, tmp_path):
    if shutil.which("c++") is None:
        pytest.skip("no C++ compiler")
    _, code = write_source(write(train("ppo", small(), steps=0), "ppo", small()))
    (tmp_path / "policy.h").write_text(code.header)
    (tmp_path / "policy.c").write_text(code.source)
    (tmp_path / "main.cpp").write_text(
        '#include "policy.h"\nint main() { float observation[POLICY_OBSERVATION_SIZE] = {}; '
        "float action[POLICY_ACTION_SIZE]; policy_act(observation, action); }\n"
    )
    for command in (
        [*find_compiler(), *FLAGS, "-c", "policy.c"],
        ["c++", "main.cpp", "policy.o", "-lm", "-o", "main"],
        ["./main"],
    ):
        subprocess.run(command, cwd=tmp_path, check=True)


def test_a_compiler_that_cannot_be_started(small, train, write, tmp_path, monkeypatch):
    broken = tmp_path / "cc"
    broken.write_bytes(b"\x7fELF")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    path = write(train("ppo", small(), steps=0), "ppo", small())
    with pytest.raises(AnswerIsNo, match="cc cannot be started: Exec format error"):
        export_policy(ExportRequest(str(path), ("c",), "best", tmp_path / "policy.c"))
