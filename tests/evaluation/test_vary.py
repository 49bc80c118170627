"""`rlctl eval --vary`: maps over events and parameters, with the same episodes in every cell."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest

from rlctl.engine import Engine
from rlctl.environments.spec import EnvChanges, EnvSpec
from rlctl.errors import AnswerIsNo, ArtifactError, UsageError
from rlctl.evaluation.episode_statistics import mean_interval
from rlctl.evaluation.eval_request import EvalRequest, Gates
from rlctl.evaluation.evaluate import run_evaluation
from rlctl.evaluation.robustness import apply_axes, read, read_axes
from rlctl.evaluation.vary import check_gates, format_command, measure_robustness
from rlctl.output import format_duration
from rlctl.policy.file import PolicyFile
from rlctl.runs.report.plots import plot_robustness
from tests.evaluation.conftest import ENVS, write_run

BLOCK = EnvSpec(f"{ENVS}:Block")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """The block's chance to stay, over the force of pushes and its mass; in a run of its own."""
    run = write_run(tmp_path_factory.mktemp("measured") / "run", f"{ENVS}:Block")
    request = EvalRequest(str(run.path), episodes=5)
    return measure_robustness(request, ["push=0:3:3", "mass=1:3:2"])


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_cell_is_the_evaluation_with_its_values(block_run, measured):
    (found,) = measured.maps
    assert [(axis.name, axis.setting, axis.values, axis.nominal) for axis in found.axes] == [
        ("push", "events.push.force", [0.0, 1.5, 3.0], 0.0),
        ("mass", "events.mass.factor", [1.0, 3.0], 1.0),
    ]
    assert [cell.values for cell in found.cells] == [[0, 1], [0, 3], [1.5, 1], [1.5, 3], [3, 1], [3, 3]]
    changes = EnvChanges(randomize=False, events={"push": {"force": 1.5}, "mass": {"factor": 3.0}})
    alone = run_evaluation(EvalRequest(str(block_run.path), episodes=5, changes=changes))
    cell = found.cells[3]
    assert (cell.success_rate, cell.success_interval) == (alone.success_rate, alone.success_interval)
    assert cell.mean_return == alone.returns.mean
    assert cell.return_interval == mean_interval([episode.result.total_reward for episode in alone.played])


@pytest.mark.pybullet
def test_nominal_and_worst_cells(measured):
    (found,) = measured.maps
    assert [cell.nominal for cell in found.cells] == [True, False, False, False, False, False]
    assert measured.nominal.success_rate == found.cells[0].success_rate == 1.0
    # The lightest block flies the furthest: 3 N for 0.1 s are 3 m/s.
    assert measured.find_worst() == (found, found.cells[4])
    assert found.cells[4].success_rate == 0.0


def test_interval_of_the_mean_by_hand():
    returns = [1.0, 2.0, 3.0, 6.0]
    # Mean 3, standard deviation sqrt(14 / 3) = 2.160247, over sqrt(4): 1.080123; t of 3 degrees of freedom: 3.182446.
    assert mean_interval(returns) == pytest.approx((3 - 3.437435, 3 + 3.437435), abs=1e-5)
    assert mean_interval(returns[:1]) == (1.0, 1.0)


@pytest.mark.pybullet
def test_it_is_kept_with_the_run(measured):
    file = Path(measured.policy_file).parents[1] / "robustness.json"
    assert read(file) == measured
    file.write_text('{"format": 1, "task": 3}')
    with pytest.raises(ArtifactError, match=r"robustness\.json: damaged: task"):
        read(file)


@pytest.mark.slow
@pytest.mark.pybullet
def test_parameters_of_the_task_are_varied_too(block_run):
    request = EvalRequest(str(block_run.path), episodes=3)
    result = measure_robustness(request, ["push.force=0:3:2", "limit=0.1:9:2"])
    (found,) = result.maps
    assert [cell.success_rate for cell in found.cells] == [1.0, 1.0, 0.0, 1.0]
    assert [cell.nominal for cell in found.cells] == [True, False, False, False]
    # What was measured with fewer episodes does not mix with what was there.
    assert read(block_run.robustness_file).maps == result.maps


@pytest.mark.slow
@pytest.mark.pybullet
def test_command_line_draws_the_map_and_gates_the_worst_cell(rlctl, block_run):
    arguments = ("eval", block_run.path, "--episodes", 3, "--vary", "push=0:6:2", "--vary", "mass=1:2:2")
    done = rlctl(*arguments, "--min-success", "0.5")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        "error: gate missed in the worst cell, push 6, mass 1: success rate 0.000 is below 0.5"
    )
    lines = done.stdout.splitlines()
    assert lines[1:3] == [
        "3 episodes in every cell, the same seeds (seed 0)",
        "nominal: success 100.0% (29.2% to 100.0%), return " + lines[2].partition("return ")[2],
    ]
    assert [line.split() for line in lines[4:8]] == [
        ["push", "\\", "mass", "1", "2"],
        ["0", "100*", "100"],
        ["6", "0<", "0"],
        ["success", "[%];", "*", "nominal,", "<", "worst"],
    ]
    assert lines[9].startswith("worst: push 6, mass 1: success 0.0% (0.0% to 70.8%), return -")
    assert lines[10] == (
        f"to play only these episodes: rlctl eval {block_run.best_policy} --episodes 3 --seed 0 "
        "--set randomize=false --set events.push.force=6 --set events.mass.factor=1"
    )


@pytest.mark.pybullet
def test_the_command_for_one_cell_is_the_whole_of_it(measured):
    (found,) = measured.maps
    axis = found.axes[0].model_copy(update={"setting": "task.limit"})
    cell = found.cells[0].model_copy(update={"values": [0.1234567891]})
    found = found.model_copy(update={"axes": [axis]})
    result = measured.model_copy(
        update={
            "policy_file": "my runs/best.safetensors",
            "deterministic": False,
            "parameters": {"goal": [1, 2], "limit": 3.0},
            "reward_weights": {"distance": 0.5},
            "events": {"mass": {"factor": [0.9, 1.1]}, "push": {}},
        }
    )
    assert format_command(result, found, cell) == (
        f"rlctl eval 'my runs/best.safetensors' --episodes {measured.episodes} --seed {measured.seed} --stochastic "
        "--set 'task.goal=[1, 2]' --set task.limit=0.1234567891 --set reward_weights.distance=0.5 "
        "--set 'events.mass.factor=[0.9, 1.1]' --set 'events.push={}' --set randomize=false"
    )


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("vary", [["push=0:3:2", "mass=1:3:2"], ["sim=0.01:0.02:2"]], ids=["events", "sim"])
def test_the_command_for_one_cell_plays_it_and_leaves_the_measurement(vary, rlctl, tmp_path):
    run = write_run(tmp_path / "run", f"{ENVS}:Block")
    result = measure_robustness(EvalRequest(str(run.path), episodes=3), vary)
    (found,) = result.maps
    stored = run.robustness_file.read_bytes()
    command = format_command(result, found, found.cells[-1])
    played = rlctl(*shlex.split(command)[1:], "--json", "-")
    assert played.returncode == 0, played.stderr
    assert json.loads(played.stdout)["return"]["mean"] == found.cells[-1].mean_return
    assert run.robustness_file.read_bytes() == stored


@pytest.mark.slow
@pytest.mark.pybullet
def test_the_command_leaves_out_what_the_policy_file_has(tmp_path):
    run = write_run(tmp_path / "run", f"{ENVS}:Block")
    own = EnvSpec(f"{ENVS}:Block", {"limit": 5.0}, {"distance": -2.0})
    PolicyFile.read(run.best_policy).with_info(spec=own).write(run.best_policy)
    changes = EnvChanges(reward_weights={"distance": -3.0})
    result = measure_robustness(EvalRequest(str(run.path), episodes=2, changes=changes), ["mass=1:3:2"])
    (found,) = result.maps
    assert format_command(result, found, found.cells[0]).partition("--seed 0 ")[2] == (
        "--set reward_weights.distance=-3.0 --set randomize=false --set events.mass.factor=1"
    )


@pytest.mark.pybullet
def test_the_command_names_what_the_measurement_changed(measured):
    (found,) = measured.maps
    changed = measured.model_copy(
        update={"sim": Engine("mujoco", 0.01), "randomize": True, "other_task": "reach", "events": {}}
    )
    command = format_command(changed, found, found.cells[0])
    assert "--task reach --sim mujoco:0.01" in command
    assert "--set randomize=true" in command
    assert measured.sim == Engine()  # the policy's own


@pytest.mark.slow
@pytest.mark.pybullet
def test_command_line_as_json(rlctl, block_run):
    done = rlctl("eval", block_run.path, "--episodes", 2, "--vary", "friction=0.2:1:2", "--json", "-")
    content = json.loads(done.stdout)
    assert content["maps"][0]["axes"][0]["nominal"] is None
    assert [cell["values"] for cell in content["maps"][0]["cells"]] == [[0.2], [1.0]]


@pytest.mark.pybullet
def test_a_long_measurement_is_not_begun_unasked(block_run):
    vary = ["push=0:3:1000", "mass=1:2:1000"]
    with pytest.raises(UsageError, match=r"1,000,000 cells will take about [\d.]+ (h|days): .*start anyway with --yes"):
        measure_robustness(EvalRequest(str(block_run.path), episodes=2), vary)
    assert [format_duration(seconds) for seconds in (50, 600, 5400, 200_000)] == ["50 s", "10 min", "1.5 h", "2.3 days"]


@pytest.mark.pybullet
def test_gates_without_a_map_are_for_the_nominal_cell(measured):
    alone = measured.model_copy(update={"maps": []})
    check_gates(alone, Gates(min_success=1.0))
    with pytest.raises(AnswerIsNo, match="in the worst cell, nominal: mean return"):
        check_gates(alone, Gates(min_return=1.0))


def test_all_events_over_twice_their_range():
    maps = {axis.name: axis for (axis,) in read_axes(["all"], EnvSpec("reach"))}
    assert "color" not in maps
    # Twice as far from nominal: 1 for factors, 0 for noise, delays and shifts.
    assert maps["mass"].values == pytest.approx([0.6, 0.8, 1.0, 1.2, 1.4])
    assert maps["motor_strength"].values == pytest.approx([0.6, 0.7, 0.8, 0.9, 1.0])
    assert maps["gravity"].values == pytest.approx([-1.0, -0.5, 0.0, 0.5, 1.0])
    assert maps["action_delay"].values == [0, 1, 2, 3, 4]
    assert maps["observation_delay"].values == [0, 1, 2]  # whole steps
    # The built world's friction is not known: twice as far from the middle of (0.3, 1.5), as far as possible.
    friction = {axis.name: axis for (axis,) in read_axes(["all"], BLOCK)}["friction"]
    assert (friction.values[0], friction.values[-1], friction.nominal) == (0.0, pytest.approx(2.1), None)


def test_an_event_that_acts_has_no_nominal_value():
    spec = EnvSpec(BLOCK.task, randomize=True)
    assert read_axes(["mass=0.5:2:4"], spec)[0][0].nominal is None


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        (
            ["masss=0.5:2:4"],
            r"no event or number of that name\. Did you mean 'mass'\? It has: mass, friction, push, limit",
        ),
        (
            ["push.forces=0:2:4"],
            r"event 'push' has no random parameter 'forces'\. Did you mean 'force'\? It has: force, duration_s",
        ),
        (["mass=0.5:2:1"], "2 to 1,000 values, .*for a single value use --set"),
        (["mass=2:2:4"], "write NAME=LOWEST:HIGHEST:VALUES"),
        (["mass=nan:2:4"], "write NAME=LOWEST:HIGHEST:VALUES"),
        (["mass"], "write NAME=LOWEST:HIGHEST:VALUES"),
        (["mass=-1:2:4"], "-1 is not above 0"),
        (["mass=1:2:1001"], "2 to 1,000 values"),
        (["mass=1:2:2", "push=0:1:2", "friction=0:1:2"], "one or two axes"),
        (["all", "push=0:1:2"], "one or two axes"),
        (["mass=1:2:2", "mass.factor=1:2:2"], "events.mass.factor is given twice"),
    ],
)
def test_bad_maps(vary, message):
    with pytest.raises(UsageError, match=message):
        read_axes(vary, BLOCK)


def test_plain_environments_have_parameters_only():
    (axis,) = read_axes(["g=9:11:3"], EnvSpec("Pendulum-v1"))[0]
    assert (axis.setting, axis.nominal, axis.whole) == ("task.g", 10.0, False)
    with pytest.raises(UsageError, match="Pendulum-v1 has no events; name one of its parameters"):
        read_axes(["all"], EnvSpec("Pendulum-v1"))


@pytest.mark.parametrize(
    ("vary", "values", "kind"),
    [
        ("typed=1:4:4", [1, 2, 3, 4], int),
        ("typed=1:2:3", [1, 2], int),
        ("untyped=1:4:4", [1, 2, 3, 4], int),
        ("untyped=1:2:3", [1, 1.5, 2], float),  # its default, 2, may mean 2.0
        ("real=1:4:4", [1, 2, 3, 4], float),
    ],
)
def test_whole_numbers_of_plain_environments(vary, values, kind):
    spec = EnvSpec(f"{ENVS}:Chain")
    (axis,) = read_axes([vary], spec)[0]
    assert axis.values == values
    (value,) = apply_axes([axis], axis.values[:1], spec).parameters.values()
    assert type(value) is kind


@pytest.mark.slow
def test_map_of_a_plain_environment(tmp_path, rlctl):
    run = write_run(tmp_path / "run", "Pendulum-v1")
    done = rlctl("eval", run.path, "--episodes", 2, "--vary", "g=5:10:2")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[4].split() == ["g", "return", "95", "%", "interval"]
    assert [line.split()[0] for line in lines[5:7]] == ["5", "10"]
    low, high = (cell.mean_return for cell in read(run.robustness_file).maps[0].cells)
    assert low != high
    refused = rlctl("eval", run.path, "--episodes", 2, "--vary", "g=5:10:2", "--min-success", "0.5")
    assert refused.returncode == 2
    assert "--min-success: this task reports no success" in refused.stderr


def test_events_set_in_a_standing_world_act_as_in_a_new_one():
    changed = EnvSpec("reach", events={"mass": {"factor": 0.6}, "observation_delay": {"steps": 2}})
    standing, fresh = EnvSpec("reach").make(), changed.make()
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 7)).astype(np.float32)
    try:
        from rlctl.task.events import EventSettings

        standing.reset(seed=1)
        standing.step(actions[0])
        standing.unwrapped.set_events(EventSettings(changes=changed.events))
        np.testing.assert_array_equal(standing.reset(seed=2)[0], fresh.reset(seed=2)[0])
        for action in actions:
            np.testing.assert_array_equal(standing.step(action)[0], fresh.step(action)[0])
    finally:
        standing.close()
        fresh.close()


@pytest.mark.slow
@pytest.mark.pybullet
def test_contacts_from_soft_to_stiff(rlctl):
    pytest.importorskip("mujoco")
    done = rlctl("eval", "reach", "--pretrained", "--vary", "sim", "--episodes", "2", "--json", "-")
    assert done.returncode == 0, done.stderr
    (engine,) = json.loads(done.stdout)["maps"]
    assert engine["axes"][0]["values"] == [0.02, 0.01, 0.005]
    assert [cell["success_rate"] for cell in engine["cells"]] == [1.0, 1.0, 1.0]


@pytest.mark.slow
def test_the_worst_contacts_are_gated(rlctl):
    pytest.importorskip("mujoco")
    options = ("--episodes", "2", "--vary", "sim=0.01:0.02:2", "--min-success", "0.9")
    done = rlctl("eval", "biped-3d", "--pretrained", *options)
    assert done.returncode == 1
    assert "gate missed in the worst cell, mujoco solref 0.01" in done.stderr
    assert "--sim mujoco:0.01 --set randomize=false" in done.stdout


@pytest.mark.slow
@pytest.mark.pybullet
def test_what_mujoco_has_not_is_said_before_an_episode_is_played(rlctl, tmp_path):
    pytest.importorskip("mujoco")
    run = write_run(tmp_path / "run", "tests.task.tasks:Stadium")
    done = rlctl("eval", run.path, "--sim", "mujoco")
    assert done.returncode == 3
    assert done.stderr.endswith("plane_stadium.sdf: MuJoCo reads URDF and MJCF (.xml) files\n")


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_cell_that_fails_is_a_failed_cell(rlctl, tmp_path):
    run = write_run(tmp_path / "run", f"{ENVS}:Brittle")
    arguments = ("eval", run.path, "--episodes", 2, "--vary", "stiffness=-2:4:4")
    done = rlctl(*arguments)
    assert done.returncode == 0, done.stderr
    result = read(run.robustness_file)
    assert [(cell.values, "negative stiffness" in cell.failure) for cell in result.maps[0].failed] == [
        ([-2.0], True), ([4.0], False)
    ]  # fmt: skip
    assert [cell.values for cell in result.maps[0].played] == [[0.0], [2.0]]
    lines = done.stdout.splitlines()
    assert [line.split()[-1] for line in (lines[5], lines[8])] == ["failed", "failed"]
    assert lines[-1].startswith("failed: stiffness 4: task '")
    assert "inf" in lines[-1]
    assert plot_robustness(result.maps[0]).startswith("<svg")
    gated = rlctl(*arguments, "--min-success", "0.1")
    assert gated.returncode == 1
    assert gated.stderr.splitlines()[-1].startswith(
        "error: gate missed: the episodes could not be played at stiffness -2: task '"
    )
    everywhere = rlctl(*arguments[:-1], "stiffness=3:4:2")
    assert everywhere.returncode == 3
    assert "so it is in every cell of --vary" in everywhere.stderr
    assert read(run.robustness_file).maps == result.maps


@pytest.mark.pybullet
def test_the_nominal_setting_may_be_the_worst(measured):
    worse = measured.nominal.model_copy(update={"success_rate": -0.1})
    turned = measured.model_copy(update={"nominal": worse})
    assert turned.find_worst() is None  # no cell of a map
    assert turned.name_worst() == ("nominal", worse)
    with pytest.raises(AnswerIsNo, match="gate missed in the worst cell, nominal: "):
        check_gates(turned, Gates(min_success=0.0))


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_function_of_the_user_has_maps_too(tmp_path, monkeypatch, rlctl):
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text("def act(observation):\n    return [0.0]\n")
    done = rlctl("eval", f"{ENVS}:Block", "--policy", "own.py:act", "--vary", "push=0:3:2", "--episodes", "3", "--push")
    assert done.returncode == 0, done.stderr
    assert "worst: push 3: success 0.0%" in done.stdout
    words = shlex.split(done.stdout.partition("to play only these episodes: ")[2].splitlines()[0])
    assert words[:5] == ["rlctl", "eval", f"{ENVS}:Block", "--policy", f"{tmp_path / 'own.py'}:act"]
    again = rlctl(*words[1:])
    assert "0.0%" in again.stdout


def test_looks_are_varied_for_policies_that_see():
    seen = {axis.name for (axis,) in read_axes(["all"], EnvSpec("pick", observe=("camera", "joint_positions")))}
    blind = {axis.name for (axis,) in read_axes(["all"], EnvSpec("pick"))}
    assert seen - blind == {
        "block_color", "arm_color", "table_color", "light", "camera_pose", "wrist_camera_pose", "distractors",
    }  # fmt: skip
    assert "mass" in blind
