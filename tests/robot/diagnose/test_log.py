"""Reading logs: columns by name, and errors that name row and column."""

import zipfile

import numpy as np
import pytest

from rlctl.errors import ArtifactError
from rlctl.task.joints import Joints
from rlctl.task.terms import Distance, LastAction, Playback
from rlctl_robot.diagnose import table
from rlctl_robot.diagnose.candidates import TermStatistics, is_of_joints, list_candidates
from rlctl_robot.diagnose.log import read_robot_log
from tests.limits.conftest import make_arm

NAMES = ["time", "positions_0", "positions_1", "goal_x", "goal_y", "goal_z", "action_0", "action_1"]


@pytest.fixture
def info():
    return make_arm().model_copy(update={"joints": Joints(["shoulder", "elbow"])})


@pytest.fixture
def rows():
    """A hundred rows, 0.1 s apart; element k of row i is i + k / 10."""
    values = np.arange(100.0)[:, None] + np.arange(7) / 10
    return np.column_stack([np.arange(100) * 0.1, values])


def write(path, rows, names=NAMES):
    lines = [",".join(names), *(",".join(str(value) for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_columns_by_name_index_axis_and_joint(tmp_path, info, rows):
    log = read_robot_log(write(tmp_path / "log.csv", rows), info)
    assert log.signals.observations[3] == pytest.approx([3.0, 3.1, 3.2, 3.3, 3.4])
    assert log.signals.actions[3] == pytest.approx([3.5, 3.6])
    # By the joints' names, in another order than the policy's.
    names = ["t", "positions_elbow", "positions_shoulder", *NAMES[3:6], "action_elbow", "action_shoulder"]
    log = read_robot_log(write(tmp_path / "log.csv", rows, names), info)
    assert log.signals.observations[3, :2] == pytest.approx([3.1, 3.0])
    assert log.signals.actions[3] == pytest.approx([3.6, 3.5])


def test_other_columns_may_hold_anything(tmp_path, info, rows):
    rows = [[*row, "running"] for row in rows.tolist()]
    assert len(read_robot_log(write(tmp_path / "log.csv", rows, [*NAMES, "state"]), info).signals.actions) == 100


def test_the_closest_name_is_used_and_said(tmp_path, info, rows):
    names = [name.replace("positions", "joint positions") for name in NAMES]
    log = read_robot_log(write(tmp_path / "log.csv", rows, names), info)
    assert "positions: columns joint positions_0 to joint positions_1, whose name is the closest" in log.notes


def test_what_cannot_be_decided_needs_a_file(tmp_path, info, rows):
    names = [*NAMES[:3], "u", "v", "w", *NAMES[6:]]
    path = write(tmp_path / "log.csv", rows, names)
    with pytest.raises(ArtifactError, match=r"no 3 columns for goal.*\n.*--columns FILE"):
        read_robot_log(path, info)
    columns = tmp_path / "columns.yaml"
    columns.write_text("observations: {goal: [w, v, u]}\n")
    assert read_robot_log(path, info, columns).signals.observations[3, 2:] == pytest.approx([3.4, 3.3, 3.2])
    columns.write_text("observations: {gaol: [w, v, u]}\n")
    with pytest.raises(ArtifactError, match=r"no observation 'gaol'\. Did you mean 'goal'"):
        read_robot_log(path, info, columns)
    columns.write_text("observations: {goal: [w, v]}\n")
    with pytest.raises(ArtifactError, match="goal has 3 elements, and 2 columns are given"):
        read_robot_log(path, info, columns)


@pytest.mark.parametrize("value", ["off", "nan", "inf", "", "1_7"])
def test_text_in_a_number_names_line_and_column(tmp_path, info, rows, value):
    rows = rows.astype(object)
    rows[41, 4] = value
    with pytest.raises(ArtifactError, match=rf"line 43, column goal_y: '{value}' is not a finite number"):
        read_robot_log(write(tmp_path / "log.csv", rows), info)


def write_with_commas(path, rows, delimiter=";"):
    lines = [NAMES, *([str(value).replace(".", ",") for value in row] for row in rows)]
    path.write_text("\n".join(delimiter.join(line) for line in lines) + "\n")
    return path


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_decimal_commas_are_read_where_columns_are_separated_otherwise(tmp_path, info, rows, delimiter):
    log = read_robot_log(write_with_commas(tmp_path / "log.csv", rows, delimiter), info)
    same = read_robot_log(write(tmp_path / "points.csv", rows), info)
    assert (log.signals.observations == same.signals.observations).all()
    assert (log.signals.actions == same.signals.actions).all()


def test_numbers_of_two_decimal_marks_are_refused(tmp_path, info, rows):
    path = write_with_commas(tmp_path / "log.csv", rows)
    path.write_text(path.read_text().replace(";50,6", ";50.6"))
    with pytest.raises(
        ArtifactError, match=r"'50\.6' is not a finite number; numbers before it have ',' as decimal mark"
    ):
        read_robot_log(path, info)


def test_decimal_commas_between_commas_are_named(tmp_path, info, rows):
    path = write_with_commas(tmp_path / "log.csv", rows, ",")
    fix = "if commas are also in numbers, separate columns by semicolons"
    with pytest.raises(ArtifactError, match=f"line 2: 16 values for 8 columns; {fix}"):
        read_robot_log(path, info)


def test_a_short_line_is_named(tmp_path, info, rows):
    path = write(tmp_path / "log.csv", rows)
    path.write_text(path.read_text().replace("50.6", "", 1).replace("50.5,", "50.5"))
    with pytest.raises(ArtifactError, match="line 52: 7 values for 8 columns"):
        read_robot_log(path, info)


def test_one_row_and_too_few_rows(tmp_path, info, rows):
    with pytest.raises(ArtifactError, match="1 row after the header; diagnose needs 60 or more"):
        read_robot_log(write(tmp_path / "log.csv", rows[:1]), info)
    with pytest.raises(ArtifactError, match="30 rows in parts without gaps"):
        read_robot_log(write(tmp_path / "log.csv", rows[:30]), info)


def test_a_gap_begins_a_new_part(tmp_path, info, rows):
    rows[60:, 0] += 5.0
    log = read_robot_log(write(tmp_path / "log.csv", rows), info)
    assert log.signals.lengths == (60, 40)
    assert any("line 62: a gap in the time; the rows after it are a new part" in note for note in log.notes)


def test_time_that_goes_back_another_rate_and_mixed_rates(tmp_path, info, rows):
    back = rows.copy()
    back[50:, 0] -= 5.0
    with pytest.raises(ArtifactError, match="line 52: time does not increase"):
        read_robot_log(write(tmp_path / "log.csv", back), info)
    with_episodes = np.column_stack([back, np.arange(100) >= 50])
    log = read_robot_log(write(tmp_path / "log.csv", with_episodes, [*NAMES, "episode"]), info)
    assert log.signals.lengths == (50, 50)
    other = rows.copy()
    other[:, 0] *= 2
    with pytest.raises(ArtifactError, match=r"a row every 0.2 s, but the policy acts every 0.1 s"):
        read_robot_log(write(tmp_path / "log.csv", other), info)
    mixed = rows.copy()
    mixed[:, 0] = np.cumsum(np.where(np.arange(100) % 5 == 4, 0.05, 0.1))
    with pytest.raises(ArtifactError, match=r"line 6: mixed rates: a row after 0.05 s, most after 0.1 s"):
        read_robot_log(write(tmp_path / "log.csv", mixed), info)


def test_arrays_of_an_npz(tmp_path, info, rows):
    path = tmp_path / "log.npz"
    # An episode has an observation more than actions.
    np.savez(path, observations=np.vstack([rows[:, 1:6], rows[:1, 1:6]]), actions=rows[:, 6:])
    log = read_robot_log(path, info)
    assert log.signals.observations[3] == pytest.approx([3.0, 3.1, 3.2, 3.3, 3.4])
    values = rows[:, 1:3].copy()
    values[7, 1] = np.nan
    np.savez(path, positions=values, goal=rows[:, 3:6], actions=rows[:, 6:])
    with pytest.raises(ArtifactError, match="row 7, column positions_1: nan is not a finite number"):
        read_robot_log(path, info)
    path.write_bytes(b"PK")
    with pytest.raises(ArtifactError, match=r"damaged, or not an \.npz file"):
        read_robot_log(path, info)


@pytest.mark.parametrize("shape", ["(3, 1000000000000)", "(1000000000000, 9999)", "(3, -1)"])
def test_an_npz_declares_more_than_it_has(tmp_path, info, shape):
    path = tmp_path / "log.npz"
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("positions.npy", b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header + bytes(72))
    with pytest.raises(ArtifactError, match=r"log\.npz: "):
        read_robot_log(path, info)


def test_an_encrypted_npz(tmp_path, info, rows):
    path = tmp_path / "log.npz"
    np.savez(path, positions=rows)
    content = bytearray(path.read_bytes())
    content[6] |= 1
    content[content.rfind(b"PK\1\2") + 8] |= 1
    path.write_bytes(content)
    with pytest.raises(ArtifactError, match=r"log\.npz: positions\.npy: damaged: .* is encrypted"):
        read_robot_log(path, info)


def test_pickles_are_never_loaded(tmp_path, info, rows):
    path = tmp_path / "log.npz"
    np.savez(path, observations=np.array([object()] * 3), actions=rows[:, 6:])
    with pytest.raises(ArtifactError, match="no 2 columns for positions"):
        read_robot_log(path, info)


@pytest.mark.slow
def test_of_large_files_parts_are_read(tmp_path, info, rows, monkeypatch):
    many = np.tile(rows, (200, 1))
    many[:, 0] = np.arange(len(many)) * 0.1
    path = write(tmp_path / "log.csv", many)
    monkeypatch.setattr(table, "_WHOLE_CSV", 10_000)
    monkeypatch.setattr(table, "_WINDOWS", 4)
    log = read_robot_log(path, info)
    assert len(log.signals.lengths) == 4
    assert max(log.signals.lengths) == 500
    monkeypatch.setattr(table, "_WHOLE_ROWS", 1000)
    np.savez(tmp_path / "log.npz", time=many[:, 0], observations=many[:, 1:6], actions=many[:, 6:])
    parts = read_robot_log(tmp_path / "log.npz", info)
    assert parts.signals.lengths == (500,) * 4
    assert parts.signals.actions[500] == pytest.approx(many[int(parts.row(500)), 6:])


def test_neither_csv_nor_npz(tmp_path, info):
    (tmp_path / "log.mcap").write_bytes(b"x")
    with pytest.raises(ArtifactError, match=r"not a log that diagnose reads: give a \.csv, \.npz or \.rrd file"):
        read_robot_log(tmp_path / "log.mcap", info)


def test_what_a_controller_takes(tmp_path, info, rows):
    info = info.model_copy(
        update={
            "observation_sizes": {"positions": 2, "last_action": 2, "goal": 1},
            "observation_terms": {"last_action": LastAction(), "goal": Distance("to", "from")},
            "quantity_sizes": {"to": 1, "from": 1},
        }
    )
    names = ["time", "positions_0", "positions_1", "to", "from", "spare", "action_0", "action_1"]
    log = read_robot_log(write(tmp_path / "log.csv", rows, names), info)
    assert "its columns are what an exported controller takes: positions, to, from" in log.notes[0]
    assert log.signals.sizes == {"positions": 2, "last_action": 2, "goal": 1}
    assert log.signals.observations[0] == pytest.approx([0.0, 0.1, 0.0, 0.0, 0.1])
    assert log.signals.observations[3] == pytest.approx([3.0, 3.1, 2.5, 2.6, 0.1])  # the action of the row before


def test_a_command_is_not_corrected(info):
    statistics = {name: TermStatistics(np.zeros(3), np.ones(3)) for name in ("command", "goal", "hand")}
    info = info.model_copy(update={"command_ranges": {f"goal_{axis}": (0.0, 1.0) for axis in "xyz"}})
    assert {one.term for one in list_candidates(info, statistics)} == {"hand"}


def test_what_a_clip_wants_is_not_corrected(info):
    statistics = {name: TermStatistics(np.zeros(3), np.ones(3)) for name in ("motion", "joint_error")}
    row = [[0.0, 0.0, 0.0]]
    clip = {"motion": Playback(row, 0.02), "joint_error": Playback(row, 0.02, "joint_positions")}
    info = info.model_copy(update={"observation_terms": clip})
    assert {one.term for one in list_candidates(info, statistics)} == {"joint_error"}


def test_what_a_clip_wants_of_the_joints_is_not_what_their_driver_measures(info):
    joints = Joints(["shoulder", "elbow"], default_positions=[0.1, -0.5])
    terms = {"joints": Playback([[0.0, 0.0]], 0.02), "joint_error": Playback([[0.0, 0.0]], 0.02, "joint_positions")}
    info = info.model_copy(update={"joints": joints, "observation_terms": terms})
    values = TermStatistics(np.zeros(2), np.ones(2))
    assert [name for name in terms if is_of_joints(name, values, info)] == ["joint_error"]


def test_a_swap_of_a_programs_own_angles(info):
    # The stance is 0.1 and -0.5 rad; an action of 1 is 0.5 rad and 0.25 rad.
    joints = Joints(["shoulder", "elbow"], default_positions=[0.1, -0.5], action_scale=[0.5, 0.25])
    info = info.model_copy(update={"joints": joints, "observation_units": {"positions": "rad", "speeds": "rad/s"}})
    statistics = {name: TermStatistics(np.zeros(2), np.ones(2)) for name in ("positions", "speeds", "actions")}
    swaps = {one.term: one for one in list_candidates(info, statistics) if one.kind == "order" and one.offset}
    assert list(swaps) == ["positions", "actions"]
    # Angles 0.3, 0.2: from the stance 0.2, 0.7. Exchanged, the program has 0.2, 0.3, and takes them for 0.1, 0.8.
    assert swaps["positions"].change(np.array([0.1, 0.8])) == pytest.approx([0.2, 0.7])
    # Actions 1, 2 are targets 0.6, 0. The robot goes to 0, 0.6: -0.2 and 4.4 are the actions for that.
    assert swaps["actions"].change(np.array([1.0, 2.0])) == pytest.approx([-0.2, 4.4])
    assert swaps["actions"].text == "elements 0 and 1 are swapped, among the joints' targets"
    # Where angles themselves are observed, near the stance, a swap of the values is the same.
    near = {"positions": TermStatistics(np.array([0.1, -0.5]), np.ones(2))}
    assert not [one for one in list_candidates(info, near) if one.kind == "order" and one.offset]


def list_units(info, unit, mean=0.0):
    joints = Joints(["shoulder", "elbow"], default_positions=[0.1, -0.5], measured="positions")
    info = info.model_copy(update={"joints": joints, "observation_units": {"positions": unit}})
    statistics = {"positions": TermStatistics(np.full(2, mean), np.ones(2))}
    return [one for one in list_candidates(info, statistics) if one.kind == "unit"]


def test_units_are_those_of_the_quantity(info):
    degree = np.pi / 180
    angles = {round(one.factor[0], 6) for one in list_units(info, "rad")}
    assert angles == {round(degree, 6), round(2 * np.pi, 6)}  # never millimetres
    assert {one.factor[0] for one in list_units(info, "m")} == {1e-3, 1e-2}
    assert {round(one.factor[0], 6) for one in list_units(info, "rad/s")} >= {round(degree, 6)}
    assert 1e-3 not in {one.factor[0] for one in list_units(info, "rad/s")}


def test_degrees_are_of_the_measured_angles(info):
    # The stance is 0.1 and -0.5 rad. Angles 0.3 and 0.2 rad are 0.2 and 0.7 from it; in degrees 17.1887 and 11.4592,
    # of which a program takes 0.1 and -0.5.
    degrees = next(one for one in list_units(info, "rad") if one.offset and "degrees" in one.text)
    assert degrees.change(np.array([17.1887 - 0.1, 11.4592 + 0.5])) == pytest.approx([0.2, 0.7], abs=1e-5)
    assert degrees.text == "is in degrees, the policy expects radians, before the stance is subtracted"


def test_signs_are_of_the_measured_angles_too(info):
    joints = Joints(["shoulder", "elbow"], default_positions=[0.1, -0.5], measured="positions")
    info = info.model_copy(update={"joints": joints, "observation_units": {"positions": "rad"}})
    statistics = {"positions": TermStatistics(np.zeros(2), np.ones(2))}
    signs = [one for one in list_candidates(info, statistics) if one.kind == "sign" and one.offset]
    # The angle 0.2 of the elbow is 0.7 from the stance; -0.2 is 0.3 from it.
    elbow = next(one for one in signs if one.text == "element 1 has the wrong sign, before the stance is subtracted")
    assert elbow.change(np.array([0.0, 0.3])) == pytest.approx([0.0, 0.7])
