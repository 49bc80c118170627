"""`rlctl export --controller` keeps only files that act as the policy does in the task."""

import json

import numpy as np
import pytest

from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo, UsageError
from rlctl.exporting.c_source import find_compiler, write_c
from rlctl.exporting.controller.export import export_controller
from rlctl.exporting.controller.verify import Recorded, measure_limits_cost
from rlctl.exporting.export_request import ExportRequest
from rlctl.exporting.onnx_source import build
from rlctl.play.collect import Episode
from rlctl.play.messages import EpisodeResult
from rlctl.policy.file import PolicyFile
from tests.exporting import controlled
from tests.exporting.controllers import make_policy

pytestmark = [
    pytest.mark.pybullet,
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler (cc, or $CC) on this machine"),
]
LIMITS = """
command: step
measured: {position: places}
limits: {all: {speed: 0.2, acceleration: 1.0}}
lowpass_hz: 2
sensors: {goal: {range: [-3, 3]}}
"""


@pytest.fixture
def policy_of(tmp_path):
    """Write a policy of the cart with random weights; return its path."""

    def write(scale=0.5, **parameters):
        spec = EnvSpec(f"{controlled.__file__}:Cart", parameters, randomize=True)
        env = spec.make()
        path = tmp_path / "cart.safetensors"
        make_policy(describe(env), scale=scale, spec=spec.__dict__).write(path)
        env.close()
        return path

    return write


def test_the_cost_of_limits_is_one_line():
    def record(number, success, total):
        return Recorded([], [], Episode(EpisodeResult(0, number, total, 10, success, {}, None)))

    free = [record(number, True, 90.0 + number) for number in range(30)]
    limited = [record(number, number % 2 == 0, 50.0) for number in range(25)]
    # Of the first 20: 90 + (0 + .. + 19) / 20 = 99.5.
    assert str(measure_limits_cost(free, limited)) == (
        "20 episodes: success in 20 without the limits, 10 within; mean return 99.5 without the limits, 50 within"
    )
    silent = [record(number, None, 1.0) for number in range(20)]
    assert str(measure_limits_cost(silent, silent)) == "20 episodes: mean return 1 without the limits, 1 within"


@pytest.mark.slow
def test_both_files_are_verified_within_limits(policy_of, tmp_path):
    limits = tmp_path / "limits.yaml"
    limits.write_text(LIMITS)
    request = ExportRequest(str(policy_of()), ("onnx", "c"), controller=True, limits=limits, output=tmp_path / "cart.c")
    onnx, in_c = export_controller(request)
    for report in (onnx, in_c):
        assert report.agreement.observations == 2400
        assert report.agreement.max_difference < 1e-6
        assert report.max_target_difference < 1e-6
        assert report.closed_loop.agrees
        json.dumps(report.as_json(), default=str)
        assert report.details["input_sizes"] == {"places": 2, "goal": 2}
    # The limits brake the carts, and the C file agrees with the limits in Python about it.
    assert abs(in_c.closed_loop.mean_return - onnx.closed_loop.mean_return) > 1.0
    header = (tmp_path / "cart.h").read_text()
    assert "A step took " in header
    assert " *   limits: {all: {speed: 0.2, acceleration: 1}}\n" in header
    words = [word for word, _ in in_c.list_rows()]
    assert words == ["exported", "policy", "inputs", "target", "limits", "their cost", "function", *words[7:]]
    cost = in_c.details["limits_cost"]
    assert cost.mean_returns == (onnx.closed_loop.mean_return, in_c.closed_loop.mean_return)
    assert "their cost" not in [word for word, _ in onnx.list_rows()]
    assert (tmp_path / "cart.onnx").exists()
    examples = [(tmp_path / name).read_text().splitlines() for name in ("cart.c.csv", "cart.onnx.csv")]
    assert examples[0][0] == "places_0,places_1,goal_0,goal_1,action_0,action_1,target_0,target_1"
    first = np.array(examples[1][1].split(","), float)
    assert first[6:] == pytest.approx(first[:2] + 0.05 * first[4:6], abs=1e-7)  # a step, without limits
    assert [len(lines) for lines in examples] == [101, 101]


@pytest.mark.slow
def test_a_policy_that_chatters_within_limits_of_acceleration(policy_of, tmp_path):
    # Last bits of its actions decide when it turns round, and limited motions add up what differs.
    limits = tmp_path / "limits.yaml"
    limits.write_text(LIMITS.replace("lowpass_hz: 2\n", "").replace("acceleration: 1.0", "acceleration: 0.05"))
    request = ExportRequest(str(policy_of(2.0)), ("c",), controller=True, limits=limits, output=tmp_path / "cart.c")
    [report] = export_controller(request)
    assert report.agreement.max_difference < 1e-5
    assert report.closed_loop.agrees or not report.closed_loop.is_conclusive


@pytest.mark.slow
@pytest.mark.parametrize("name", ["onnx", "c"])
def test_a_wrong_declaration_is_not_written(name, policy_of, tmp_path):
    path = policy_of(fault="last action")
    request = ExportRequest(str(path), (name,), controller=True, output=tmp_path / f"wrong.{name}")
    with pytest.raises(AnswerIsNo, match="not verified, not written: it does not act as"):
        export_controller(request)
    assert not list(tmp_path.glob("wrong*"))


def test_limits_need_a_controller():
    with pytest.raises(UsageError, match="only a controller has limits; add --controller"):
        ExportRequest("run", limits="limits.yaml")


@pytest.mark.slow
@pytest.mark.parametrize(("task", "count"), [("reach", 2400), ("walk", 10_000)])
def test_bundled_tasks_have_controllers(task, count, rlctl, tmp_path):
    done = rlctl("export", task, "--pretrained", "--controller", "--json", "-", "-o", "controller.c", timeout=600)
    assert done.returncode == 0, done.stderr
    reports = json.loads(done.stdout)
    for report in (reports["onnx"], reports["c"]):
        assert report["verified"]
        assert report["observations"] == count
        assert report["max_difference"] < 1e-5
        assert report["closed_loop"]["same_success"] == 20
    assert (tmp_path / "controller.h").exists()


def test_the_c_and_onnx_of_a_policy_name_its_histories(policy_of):
    policy = PolicyFile.read(policy_of())
    assert "[0..5]     places [m], the last 3, oldest first" in write_c(policy, "cart").header
    metadata = {entry.key: entry.value for entry in build(policy).metadata_props}
    assert metadata["observation_history"] == "places:3"


@pytest.mark.slow
def test_a_controller_plays_its_clip_from_the_start(tmp_path):
    spec = EnvSpec("rlctl_locomotion.follow:QuadrupedBow", {"episode_s": 1.0})
    env = spec.make()
    path = tmp_path / "bow.safetensors"
    make_policy(describe(env), scale=0.02, spec=spec.__dict__).write(path)
    env.close()
    request = ExportRequest(str(path), ("onnx", "c"), controller=True, output=tmp_path / "bow.c")
    for report in export_controller(request):
        assert report.agreement.max_difference < 1e-5
        assert report.max_target_difference < 1e-5
        assert report.closed_loop.agrees
        # Neither the clip nor its time is an input.
        sizes = {"orientation": 4, "joint_positions": 12, "gyroscope": 3, "joint_velocities": 12}
        assert report.details["input_sizes"] == sizes
        assert report.details["target"] == "joint position [rad] = joints + target_factor * action"
