"""`rlctl distill`: what the student learns, from whom, and that a killed distillation goes on exactly."""

import ctypes.util
import functools
from pathlib import Path

import numpy as np
import onnx
import pytest
from gymnasium import spaces

from rlctl.engine import MUJOCO
from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, RecipeError
from rlctl.exporting.export import export_policy
from rlctl.exporting.export_request import ExportRequest
from rlctl.launching import distill as distilling
from rlctl.launching.distill import distill, make_settings
from rlctl.launching.distill_request import DistillRequest
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.load import load_policy
from rlctl.policy.torch_policy import build_network
from rlctl.recipe.recipe import merge
from rlctl.runs.directory import RunDirectory
from rlctl.training.distilling import labelled_steps
from rlctl.training.distilling.labelled_steps import LabelledSteps
from tests.training.comparing import Killed, assert_same_run, rows
from tests.training.conftest import ENVS

STOOL = "tests.task.batches:Stool"
needs_egl = pytest.mark.skipif(ctypes.util.find_library("EGL") is None, reason="needs libEGL")
SHORT = {
    "n_envs": 4,
    "total_timesteps": 256,
    "eval": {"episodes": 2, "every_steps": 128},
    "algo_kwargs": {"n_steps": 16, "batch_size": 32, "n_epochs": 2},
    "policy_kwargs": {"net_arch": [16]},
}


def write_teacher(folder: Path, spec: EnvSpec, weights, **options) -> Path:
    """Write a policy whose actions are linear in the observation: `weights` times it."""
    env = spec.make()
    info = PolicyInfo(
        algo="ppo", policy="MlpPolicy", policy_kwargs={"net_arch": []}, env=describe(env), spec=spec, **options
    )
    env.close()
    tensors = {
        f"policy/{name}": np.zeros_like(value.numpy()) for name, value in build_network(info).state_dict().items()
    }
    tensors["policy/action_net.weight"] = np.array(weights, np.float32)
    PolicyFile(info, tensors).write(folder / "teacher.safetensors")
    return folder / "teacher.safetensors"


@pytest.fixture
def line(tmp_path):
    """A policy that pushes the point to the origin: its action is -2 x."""
    return write_teacher(tmp_path, EnvSpec(f"{ENVS}:Line"), [[-2.0]])


@pytest.fixture
def stool(tmp_path):
    """A policy that sees the true height and place, too: it is taught by events."""
    pytest.importorskip("mujoco")
    spec = EnvSpec(STOOL, randomize=True, observe=("height", "hips", "goal")).resolve()
    return write_teacher(tmp_path, spec, [[2.0, -1.0, 0.0, 1.0], [-2.0, 0.0, 0.5, -1.0]])


@pytest.fixture
def seen_stool(tmp_path):
    """A policy of the stool that stands before cameras, whose looks events change."""
    pytest.importorskip("mujoco")
    looks = {name: {} for name in ("light", "color", "pose", "things")}
    spec = EnvSpec("tests.task.batches:SeenStool", events=looks, observe=("height", "hips", "goal")).resolve()
    return write_teacher(tmp_path, spec, [[2.0, -1.0, 0.0, 1.0], [-2.0, 0.0, 0.5, -1.0]])


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Distill into a temporary folder."""
    monkeypatch.setattr(distilling, "EPISODES", 4)

    def start(teacher, settings, **request):
        short = {key: value for key, value in SHORT.items() if key != "algo_kwargs" or "algo" not in settings}
        settings = merge(short, settings)
        return distill(
            DistillRequest(str(teacher), settings=settings, root=tmp_path / "runs", **{"check": False, **request})
        )

    return start


def test_the_oldest_steps_are_replaced(monkeypatch):
    monkeypatch.setattr(labelled_steps, "MOST_BYTES", 50)  # two additions of 24 bytes
    steps = LabelledSteps()
    for number in range(4):
        steps.add({"label": np.full((3, 2), number, np.float32)})
    assert steps.take()["labelled/rows/label"][:, 0].tolist() == [2, 2, 2, 3, 3, 3]
    steps.add({"label": np.full((3, 2), 4, np.float32)})
    restored = LabelledSteps()
    restored.restore(steps.take())
    restored.add({"label": np.full((3, 2), 5, np.float32)})
    assert sorted(restored.take()["labelled/rows/label"][:, 0].tolist()) == [4, 4, 4, 5, 5, 5]
    ours, theirs = (each.sample(np.random.default_rng(0), 5)["label"] for each in (restored, restored))
    np.testing.assert_array_equal(ours, theirs)


def test_a_student_sees_what_its_teacher_saw_unless_it_is_told_otherwise():
    teacher = EnvSpec("reach", {"tolerance": 0.1}, observe=("hand",), observation_history={"hand": 3}, sim=MUJOCO)
    same = make_settings(DistillRequest(), teacher)
    assert same["observe"] == ["hand"]
    assert same["observation_history"] == {"hand": 3}
    assert (same["task"], same["sim"]) == ({"tolerance": 0.1}, "mujoco")
    assert same["total_timesteps"] == 30_000  # a quarter of what the recipe of reach has
    other = make_settings(DistillRequest(observe="hand, goal", settings={"task": {"tolerance": 0.2}}), teacher)
    assert other["observe"] == ["hand", "goal"]
    assert "observation_history" not in other
    assert other["task"] == {"tolerance": 0.2}


@pytest.mark.slow
def test_a_student_learns_the_teachers_actions(run, line):
    settings = {"total_timesteps": 1024, "algo_kwargs": {"n_steps": 64, "n_epochs": 20}}
    result = run(line, {**settings, "policy_kwargs": {"net_arch": [16]}})
    policy = load_policy(result.training.run.last_policy)
    for place in (-0.2, 0.0, 0.3):
        assert policy.predict(np.array([place], np.float32)) == pytest.approx([-2 * place], abs=0.1)
    assert (result.student.success, result.teacher.success) == (1.0, 1.0)
    assert result.teacher.mean_return == pytest.approx(result.student.mean_return, abs=0.02)
    losses = [float(row["policy_loss"]) for row in rows(result.training.run.metrics_file)]
    assert losses[-1] < 0.2 * losses[0]


@pytest.mark.slow
def test_what_is_written_is_of_the_student(run, stool, tmp_path):
    result = run(stool, {"observation_history": {"hips": 3}}, observe="hips,speeds")
    file = result.training.run.best_policy
    info = PolicyFile.read_info(file)
    assert info.env.observation_sizes == {"hips": 6, "speeds": 2}
    assert info.spec.make().observation_space.shape == (8,)
    export_policy(ExportRequest(str(file), output=tmp_path / "policy.onnx"))
    (observed,) = onnx.load(str(tmp_path / "policy.onnx")).graph.input
    assert observed.type.tensor_type.shape.dim[-1].dim_value == 8


@pytest.mark.slow
@needs_egl
def test_a_student_sees_by_a_camera(run, seen_stool, tmp_path):
    result = run(seen_stool, {}, observe="front,hips")
    file = result.training.run.best_policy
    info = PolicyFile.read_info(file)
    assert info.env.spaces()[0]["front"] == spaces.Box(0, 255, (36, 40, 3), np.uint8)
    assert info.normalized_keys == ["hips"]
    report = export_policy(ExportRequest(str(file), output=tmp_path / "policy.onnx"))
    assert report is not None
    names = {port.name for port in onnx.load(str(tmp_path / "policy.onnx")).graph.input}
    assert names == {"front", "hips"}


def test_a_student_by_camera_takes_few_steps_and_learns_often():
    teacher = EnvSpec("tests.task.batches:SeenStool", sim=MUJOCO)
    settings = make_settings(DistillRequest(observe="front,hips", settings={"n_envs": 8}), teacher)
    assert (settings["n_envs"], settings["total_timesteps"]) == (8, 40_960)
    assert settings["algo_kwargs"]["n_epochs"] == 16
    assert "n_envs" not in make_settings(DistillRequest(observe="hips"), teacher)


def test_pictures_are_kept_as_bytes(monkeypatch):
    monkeypatch.setattr(labelled_steps, "MOST_BYTES", 0)
    monkeypatch.setattr(labelled_steps, "MOST_BYTES_OF_PICTURES", 200)  # four additions of 48 bytes
    steps = LabelledSteps()
    for number in range(5):
        steps.add({"observation/camera": np.full((1, 4, 4, 3), number, np.uint8)})
    kept = steps.take()["labelled/rows/observation/camera"]
    assert kept.dtype == np.uint8
    assert kept[:, 0, 0, 0].tolist() == [4, 1, 2, 3]


CASES = {
    "camera": ("seen_stool", {}, {"observe": "front,hips"}),
    "stool": ("stool", {"observation_history": {"hips": 2}}, {"observe": "hips,speeds"}),
    "recurrent": (
        "stool",
        {
            "algo": "recurrent_ppo",
            "algo_kwargs": SHORT["algo_kwargs"],
            "policy_kwargs": {"lstm_hidden_size": 8, "net_arch": [8]},
        },
        {"observe": "hips"},
    ),
    "then PPO": ("line", {"total_timesteps": 128}, {"then_ppo": 128}),
    "A2C": ("line", {"algo": "a2c", "algo_kwargs": {"n_steps": 16}}, {}),
}


@pytest.mark.slow
@pytest.mark.usefixtures("every_boundary")
@pytest.mark.parametrize("case", CASES)
def test_killed_and_resumed(run, resume, kill_after, tmp_path, request, case):
    teacher, settings, options = CASES[case]
    file = request.getfixturevalue(teacher)
    start = functools.partial(run, file, settings, **options)
    whole = start().training.run
    undo = kill_after(37)
    with pytest.raises(Killed):
        start()
    undo()
    file.unlink()  # the run has its own copy
    (other,) = (folder for folder in whole.path.parent.iterdir() if folder != whole.path)
    resume(RunDirectory(other))
    assert_same_run(whole, RunDirectory(other))


def test_what_cannot_be_distilled(run, line, tmp_path):
    with pytest.raises(RecipeError, match="distill: a student learns with a2c, ppo, recurrent_ppo, not with sac"):
        run(line, {"algo": "sac"})
    with pytest.raises(RecipeError, match="observe: Line has no element 'x'"):
        run(line, {}, observe="x")
    policy = PolicyFile.read(line)
    wide = policy.info.env.model_copy(update={"observation_space": {**policy.info.env.observation_space, "shape": [2]}})
    tensors = {**policy.tensors, "policy/action_net.weight": np.zeros((1, 2), np.float32)}
    tensors["policy/value_net.weight"] = np.zeros((1, 2), np.float32)
    PolicyFile(policy.info.model_copy(update={"env": wide}), tensors).write(line)
    with pytest.raises(ArtifactError, match="this teacher is not for this task: its observation space is"):
        run(line, {})
