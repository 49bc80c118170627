"""Logs of servos with hidden values: identify finds these values, names wrong columns, or says what it cannot tell."""

import json
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from rlctl.errors import AnswerIsNo, ArtifactError, UsageError
from rlctl.storage import yaml_text
from rlctl.task.mujoco.world import hide_instability
from rlctl_robot.identify.column_checks import check_commands, check_model
from rlctl_robot.identify.first_guess import Regression
from rlctl_robot.identify.motion import check_positions, read_motion, write_motion
from rlctl_robot.identify.robot import describe, identify_robot
from rlctl_robot.identify.robot_excite import draw_targets, write_robot_excitation
from rlctl_robot.identify.robot_model import (
    ARMATURE,
    BIAS,
    COULOMB,
    DELAY,
    MASS,
    STIFFNESS,
    VISCOUS,
    read_robot,
    stack_values,
)
from rlctl_robot.identify.robot_report import make_mjcf, make_motors, make_ranges, show_robot, write_robot
from rlctl_robot.identify.unknowns import list_unknowns
from rlctl_robot.identify.window_fit import WindowFitter
from rlctl_robot.identify.windows import WindowPlayer

ROBOT = Path(__file__).with_name("two_servos.xml")
DT = 0.02
ENCODER = 2 * np.pi / 4096  # [rad]
HIDDEN = {
    STIFFNESS: [60.0, 35.0],
    ARMATURE: [0.05, 0.03],
    VISCOUS: [3.0, 1.5],
    COULOMB: [0.6, 0.3],
    BIAS: [0.03, -0.04],
    DELAY: 0.023,
}


def play(robot, targets, hidden):
    """Return what the encoders of a robot with hidden values read."""
    values = robot.nominal | {name: np.array(value) for name, value in hidden.items()}
    player = WindowPlayer(robot, targets, DT, 1)
    still = np.zeros((1, len(robot.joints)))
    played = player.play(stack_values(values, 1), np.zeros(1, int), targets[:1], still, len(targets) - 1)[0]
    noise = np.random.default_rng(1).normal(0, 0.3 * ENCODER, played.shape)
    return np.round((played + noise) / ENCODER) * ENCODER


@pytest.fixture(scope="module")
def recorded():
    """The robot, targets, and what its encoders read."""
    robot = read_robot(ROBOT)
    targets = draw_targets(robot, 12.0, DT, 0.6, 0)
    return robot, targets, play(robot, targets, HIDDEN)


@pytest.fixture
def write(tmp_path, recorded):
    """Write a log with changed columns; return its path."""

    def write(targets=None, positions=None):
        robot, first, second = recorded
        path = tmp_path / "log.csv"
        write_motion(
            path,
            robot.joints,
            first if targets is None else targets,
            second if positions is None else positions,
            DT,
        )
        return path

    return write


@pytest.fixture
def small_log(recorded, tmp_path):
    """A log of the elbow alone, whose shoulder is locked."""
    robot = read_robot(ROBOT, ["elbow"])
    targets = recorded[1][:, 1:]
    write_motion(tmp_path / "log.csv", robot.joints, targets, play(robot, targets, {COULOMB: [0.5], DELAY: 0.01}), DT)
    return tmp_path / "log.csv"


@pytest.fixture(scope="module")
def identified(recorded, tmp_path_factory):
    """What is found in the log of the robot with hidden values."""
    robot, targets, positions = recorded
    path = tmp_path_factory.mktemp("log") / "log.csv"
    write_motion(path, robot.joints, targets, positions, DT)
    return identify_robot(str(ROBOT), path, threads=1)


@pytest.mark.slow
def test_hidden_values_are_found(identified):
    for quantity, hidden in HIDDEN.items():
        for joint, right in zip(["shoulder", "elbow"], np.broadcast_to(hidden, 2), strict=True):
            found = identified.find("" if quantity == DELAY else joint, quantity)
            assert found.known, found
            assert found.value == pytest.approx(right, rel=0.05, abs=0.004)
            assert found.low <= found.value <= found.high
    assert identified.error_after < 0.1 * identified.error_before
    assert identified.error_after < 2 * ENCODER


@pytest.mark.slow
def test_values_are_written_as_a_model_and_for_set_motors(identified, tmp_path):
    paths = write_robot(identified, tmp_path / "out")
    model = mujoco.MjModel.from_xml_path(str(paths[0]))
    assert model.joint("elbow").armature[0] == pytest.approx(0.03, rel=0.05)
    assert model.joint("elbow").frictionloss[0] == pytest.approx(0.3, rel=0.05)
    assert model.actuator("elbow").gainprm[0] == pytest.approx(35, rel=0.05)
    assert model.actuator("elbow").biasprm[1] == pytest.approx(-35, rel=0.05)
    written = yaml_text.load(paths[1].read_text(), "motors")
    assert written["motors"]["shoulder"][STIFFNESS] == pytest.approx(60, rel=0.05)
    assert written["motors"]["shoulder"][DELAY] == pytest.approx(0.023, abs=0.001)
    low, high = written["ranges"]["shoulder"][STIFFNESS]
    assert low <= 0.9801 * written["motors"]["shoulder"][STIFFNESS]  # the model's errors are not in an interval
    assert high >= 1.0199 * written["motors"]["shoulder"][STIFFNESS]
    assert len(written["ranges"]["all"][DELAY]) == 2
    low, high = written["events"]["motor_friction"]["coulomb_nm"]
    assert low < 0.3 < 0.6 < high
    assert written["events"]["motor_delay"]["delay_s"] == written["ranges"]["all"][DELAY]
    assert written["events"]["torque_constant"]["factor"] == [0.98, 1.02]
    show_robot(identified, paths, str(tmp_path / "found.json"))
    found = json.loads((tmp_path / "found.json").read_text())
    assert {value["quantity"] for value in found["values"]} == set(HIDDEN)


@pytest.mark.slow
def test_masses_of_links_are_found(recorded, write):
    robot, targets, _ = recorded
    heavier = {MASS: [1.0, 1.3, 0.8], DELAY: 0.01}  # of the world, upper and lower
    found = identify_robot(str(ROBOT), write(positions=play(robot, targets, heavier)), fit=["mass", "delay"], threads=1)
    for link, factor in (("upper", 1.3), ("lower", 0.8)):
        value = found.find(link, MASS)
        assert value.known
        assert value.value == pytest.approx(factor, rel=0.05)


def test_a_mass_moves_the_joints_of_its_tree():
    robot = read_robot(ROBOT)
    unknowns = list_unknowns(robot, robot.nominal, ["mass"], range(2))
    assert [item.part for item in unknowns.items] == list(robot.links) == ["upper", "lower"]
    assert unknowns.affected.all()


def test_a_delay_between_physics_steps_moves_the_commands(recorded):
    robot, _, _ = recorded
    targets = np.arange(50.0)[:, None] * np.ones(2)
    player = WindowPlayer(robot, targets, DT, 1)
    assert player.substeps == 4  # of 5 ms
    # 7 ms late: in the substep from 5 to 10 ms after row 10, row 9 for 2 ms and row 10 for 3 ms.
    commands = player._find_commands(np.array([10]), np.array([0.007]))[0, :, 0]
    assert commands == pytest.approx([9.0, 0.4 * 9 + 0.6 * 10, 10.0, 10.0])


def test_unstable_worlds_are_marked_and_hidden_warnings_are_not_printed(recorded):
    robot, targets, _ = recorded
    values = stack_values(robot.nominal, 2)
    values[STIFFNESS] = np.array([[60.0, 35.0], [1e9, 1e9]])
    player = WindowPlayer(robot, targets, DT, 1)
    printed, before = [], mujoco.get_mju_user_warning()

    def play_both():
        player.play(values, np.zeros(2, int), np.repeat(targets[:1], 2, axis=0), np.zeros((2, 2)), 50)

    mujoco.set_mju_user_warning(printed.append)
    try:
        with hide_instability():
            play_both()
        assert player.is_unstable.tolist() == [False, True]
        assert printed == []
        play_both()
        assert "The simulation is unstable" in printed[0]
    finally:
        mujoco.set_mju_user_warning(before)


@pytest.mark.slow
def test_a_resting_joint_that_begins_with_a_wrong_speed_does_not_keep_the_search(recorded):
    robot, targets, _ = recorded
    targets = targets * [1, 0]
    positions = play(robot, targets, HIDDEN)
    hidden = robot.nominal | {name: np.array(value) for name, value in HIDDEN.items()}
    unknowns = list_unknowns(robot, hidden, ["coulomb"], range(2))
    player, starts = WindowPlayer(robot, targets, DT, 1), np.arange(0, 500, 50)
    speeds = np.gradient(positions, DT, axis=0)
    wrong = speeds.copy()
    wrong[starts[3:6], 1] += 10.0  # [rad/s]
    best, found = (
        WindowFitter(player, unknowns, positions, first, starts, 50).fit(unknowns.column("first"), lambda _: None)
        for first in (speeds, wrong)
    )
    assert found.vector == pytest.approx(best.vector, rel=0.01)
    assert found.noise == pytest.approx(best.noise, rel=0.02)


@pytest.mark.slow
def test_a_joint_that_does_not_move_is_named(recorded, write):
    robot, targets, _ = recorded
    commanded = targets * [1, 0]
    still = play(robot, commanded, {STIFFNESS: [60.0, 40.0], ARMATURE: [0.02, 1e6], DELAY: 0.01})
    found = identify_robot(str(ROBOT), write(commanded, still), fit=["stiffness", "delay"], threads=1)
    assert found.find("shoulder", STIFFNESS).value == pytest.approx(60, rel=0.02)
    elbow = found.find("elbow", STIFFNESS)
    assert not elbow.known
    assert elbow.note == "elbow does not move in this log"
    assert describe(found)["values"][-1]["value"] is None
    assert "elbow" not in make_motors(found)
    assert "elbow" not in make_ranges(found)
    with pytest.raises(AnswerIsNo, match="no joint moves by more than"):
        identify_robot(str(ROBOT), write(commanded * 0, still * 0))


@pytest.mark.slow
def test_a_value_without_a_trace_is_unknown(tmp_path):
    # Around a vertical axis there is no gravity: the inertia alone tells the stiffness, the bias has no effect.
    text = ROBOT.read_text().replace('axis="0 1 0"', 'axis="0 0 1"').replace("-0.05 0 0 -0.35", "0 0.3 0 0")
    path = tmp_path / "flat.xml"
    path.write_text(text)
    robot = read_robot(path)
    targets = draw_targets(robot, 12.0, DT, 0.6, 0)
    write_motion(tmp_path / "log.csv", robot.joints, targets, play(robot, targets, {DELAY: 0.01}), DT)
    found = identify_robot(str(path), tmp_path / "log.csv", fit=["bias", "delay"], threads=1)
    shoulder = found.find("shoulder", BIAS)
    assert not shoulder.known
    assert shoulder.note == "this log contains no information about shoulder encoder_bias_rad"
    assert found.find("", DELAY).known


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda u, q: (u, q * [1, -1]), "position_elbow moves against target_elbow: one of them has the wrong sign"),
        (lambda u, q: (u, q[:, ::-1]), "position_shoulder follows target_elbow, not target_shoulder: the order"),
        (lambda u, q: (u * [1, 57.3], q), "target_elbow moves .* times as far as position_elbow: it is in degrees"),
    ],
)
def test_commands_of_other_joints_signs_and_units_are_named(recorded, write, change, message):
    _, targets, positions = recorded
    motion = read_motion(write(*change(targets, positions)), ["shoulder", "elbow"])
    with pytest.raises(AnswerIsNo, match=message):
        check_commands(motion, [0, 1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: x * [1, -1], "of elbow have another sign than in two_servos.xml"),
        (lambda x: x[:, ::-1], "of shoulder and elbow are exchanged"),
    ],
)
def test_signs_and_order_that_gravity_contradicts_are_named(recorded, write, change, message):
    robot, targets, positions = recorded
    motion = read_motion(write(change(targets), change(positions)), robot.joints)
    check_commands(motion, [0, 1])
    with pytest.raises(AnswerIsNo, match=message):
        check_model(Regression(robot, motion, np.arange(len(positions))), motion, [0, 1])


def test_degrees_and_encoders_that_wrap_are_named(recorded, write):
    robot, _, positions = recorded
    degrees = positions.copy()
    degrees[:, 1] *= 180 / np.pi
    with pytest.raises(ArtifactError, match=r"log.csv, line \d+, column position_elbow: .* the limit of elbow is 2\.5"):
        check_positions(read_motion(write(positions=degrees), robot.joints), robot)
    wrapped = positions.copy()
    wrapped[300:, 0] = np.clip(wrapped[300:, 0], -0.5, 0.5) - 5.5
    with pytest.raises(ArtifactError, match=r"log.csv, line 302, column position_shoulder: the encoder wraps"):
        check_positions(read_motion(write(positions=wrapped), robot.joints), robot)


def edit(path, change):
    """Change the lines of a log after its header."""
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *change(rows)]) + "\n")
    return path


def speed_up(rows):
    """Return rows of which the second half is four times as dense."""
    times = np.where(np.arange(600) < 300, np.arange(600) * DT, 300 * DT + (np.arange(600) - 300) * DT / 4)
    return [f"{time:.4f},{row.split(',', 1)[1]}" for time, row in zip(times, rows, strict=True)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[:50], "50 rows; identify needs 100 or more"),
        (lambda rows: [row for row in rows for _ in (0, 1)], r"line 3, column time: .* if two robots write into one"),
        (lambda rows: rows + rows, "line 602: time does not increase: 11.98 s, then 0 s"),
        (speed_up, r"line \d+: mixed rates|mixed rates"),
        (lambda rows: [f"{20 * i},{row.split(',', 1)[1]}" for i, row in enumerate(rows)], "is the time in millisec"),
        (
            lambda rows: [*rows[:7], ",".join([*rows[7].split(",")[:2], "nan", "0", "0"]), *rows[8:]],
            "line 9, column target_e",
        ),
    ],
)
def test_logs_that_are_none_are_refused_with_row_and_column(recorded, write, change, message):
    with pytest.raises(ArtifactError, match=message):
        read_motion(edit(write(), change), recorded[0].joints)


def test_a_gap_ends_a_part(recorded, write):
    path = edit(write(), lambda rows: rows[:200] + rows[260:])
    motion = read_motion(path, recorded[0].joints)
    assert motion.lengths == (200, 340)
    assert "line 202: a gap in the time" in motion.notes[-1]


def test_columns_of_other_names_and_units(recorded, tmp_path, write):
    path = write()
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join(["t,q_des_0,q_des_1,q_0,q_1", *rows]) + "\n")
    motion = read_motion(path, recorded[0].joints)
    assert motion.columns == ("q_0", "q_1")
    given = tmp_path / "columns.yaml"
    given.write_text("time: t\nobservations: {joint_positions: [q_0, q_1]}\nscale: {joint_positions: -1}\n")
    assert read_motion(path, recorded[0].joints, given).positions == pytest.approx(-motion.positions)
    path.write_text("\n".join([head.replace("time", "clock"), *rows]) + "\n")
    with pytest.raises(ArtifactError, match="no column with the time"):
        read_motion(path, recorded[0].joints)


def test_a_log_of_some_joints_locks_the_others(recorded, tmp_path):
    robot, targets, positions = recorded
    write_motion(tmp_path / "log.csv", ["elbow"], targets[:, 1:], positions[:, 1:], DT)
    motion = read_motion(tmp_path / "log.csv", robot.joints)
    alone = read_robot(ROBOT, motion.joints)
    assert alone.joints == ("elbow",)
    assert alone.model.nv == 1
    assert alone.notes == (f"{ROBOT}: not in the log, so locked: shoulder",)


@pytest.mark.slow
def test_excitation_moves_each_joint_alone_and_keeps_the_limits(tmp_path):
    found = write_robot_excitation(str(ROBOT), tmp_path / "chirp.csv", seconds=20.0, rate=50.0, seed=0, threads=1)
    motion = read_motion(found.path, ["shoulder", "elbow"])
    assert len(motion.commands) == 1000
    assert np.abs(motion.positions).max() < 0.9 * 2.5
    alone = np.ptp(motion.commands[:200], axis=0)
    assert alone[0] > 0.3
    assert alone[1] == 0
    assert (np.ptp(motion.commands[400:], axis=0) > 0.3).all()
    with pytest.raises(UsageError, match="--seconds 5"):
        write_robot_excitation(str(ROBOT), tmp_path / "chirp.csv", seconds=5.0, rate=50.0, seed=0)


@pytest.mark.slow
def test_excitation_without_a_safe_motion_names_the_links(tmp_path):
    wall = '<body name="wall" pos="0.22 0 0.7"><geom type="box" size="0.12 1 1"/></body></worldbody>'
    path = tmp_path / "caged.xml"
    path.write_text(ROBOT.read_text().replace("</worldbody>", wall))
    with pytest.raises(AnswerIsNo, match=r"no safe motion found: .* (lower|upper) touches wall|wall touches"):
        write_robot_excitation(str(path), tmp_path / "chirp.csv", seconds=10.0, rate=50.0, seed=0, threads=1)


def test_a_robot_without_servos_needs_the_stiffness(write, tmp_path):
    path = tmp_path / "bare.xml"
    text = ROBOT.read_text()
    path.write_text(text[: text.index("<actuator>")] + "</mujoco>")
    with pytest.raises(UsageError, match="no position servo for shoulder, elbow, so the stiffness must be estimated"):
        identify_robot(str(path), write(), fit=["coulomb"])
    with pytest.raises(UsageError, match=r"--fit: no quantity 'stifness'\. Did you mean 'stiffness'"):
        identify_robot(str(path), write(), fit=["stifness"])


@pytest.mark.slow
def test_a_model_that_does_not_explain_the_log_has_no_values(recorded, write):
    noise = np.random.default_rng(0).normal(size=recorded[1].shape).cumsum(axis=0) * 0.03
    with pytest.raises(AnswerIsNo, match=r"two_servos\.xml does not explain this log"):
        identify_robot(str(ROBOT), write(positions=recorded[2] + noise), fit=["coulomb", "delay"], threads=1)


@pytest.mark.slow
def test_the_written_model_moves_as_the_robot_did(identified, recorded):
    robot, targets, positions = recorded
    model = mujoco.MjModel.from_xml_string(make_mjcf(identified))
    data = mujoco.MjData(model)
    bias = [identified.find(joint, BIAS).value for joint in robot.joints]
    late = round(identified.find("", DELAY).value / model.opt.timestep)
    data.qpos[:] = positions[0] - bias
    steps = np.repeat(targets, 4, axis=0)
    read = []
    for step in range(4 * 400):
        if step % 4 == 0:
            read.append(data.qpos + bias)
        data.ctrl[:] = steps[max(step - late, 0)] - bias
        mujoco.mj_step(model, data)
    assert np.abs(np.array(read) - positions[:400]).max() < 0.02


@pytest.mark.slow
def test_commands(rlctl, small_log, tmp_path):
    found = rlctl("identify", ROBOT, "--log", small_log, "--fit", "coulomb", "--fit", "delay", "-o", tmp_path / "out")
    assert found.returncode == 0, found.stderr
    assert re.search(r"elbow +0\.(49|50)\d* ± 0\.", found.stdout), found.stdout
    assert "held out of the fit" in found.stdout
    assert (tmp_path / "out" / "two_servos.motors.yaml").is_file()
    excited = rlctl("identify", ROBOT, "--excite", tmp_path / "chirp.csv", "--seconds", "10")
    assert "each joint alone, then all" in excited.stdout


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([ROBOT], "give either --excite FILE or --log FILE"),
        ([ROBOT, "--log", "log.csv", "--event", "mass"], "--event is for a task"),
        (["reach", "--log", "log.csv", "--fit", "mass"], "--fit is for a robot's model file"),
        ([ROBOT, "--excite", "log.csv", "--fit", "mass"], "--fit is for --log"),
        (["nothing.xml", "--log", "log.csv"], "model file 'nothing.xml' not found"),
    ],
)
def test_options_that_do_not_fit(rlctl, arguments, message):
    refused = rlctl("identify", *arguments)
    assert refused.returncode == 2
    assert message in refused.stderr
