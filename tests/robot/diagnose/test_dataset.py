"""LeRobot datasets are logs: a column per number, episodes as parts, units as `--columns` gives them."""

import json
import math
import sys

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from rlctl.errors import ArtifactError, UsageError
from rlctl.task.joints import Joints
from rlctl_robot.diagnose.dataset import read_dataset_header
from rlctl_robot.diagnose.log import read_robot_log
from tests.limits.conftest import make_arm

NAMES = ["shoulder.pos", "elbow.pos"]


@pytest.fixture
def info():
    """An arm of two joints that observes their positions and a goal; a control step takes 0.1 s."""
    env = make_arm().model_copy(update={"joints": Joints(["shoulder", "elbow"])})
    return env.model_copy(update={"observation_sizes": {"joint_positions": 2, "goal": 3}})


@pytest.fixture
def write_dataset(tmp_path):
    """Write two episodes of 50 rows as a dataset of format v3.0."""

    def write(names=NAMES, state=None, dtype=np.float32, **columns):
        rows = np.arange(100)
        values = {
            "action": np.column_stack([rows + 0.5, rows + 0.6]),
            "observation.state": np.column_stack([rows, rows + 0.1]) if state is None else state,
            "observation.goal": np.column_stack([rows + 0.2, rows + 0.3, rows + 0.4]),
            **columns,
        }
        features = {
            name: {"dtype": "float32", "shape": [array.shape[1]], "names": names if array.shape[1] == 2 else None}
            for name, array in values.items()
        }
        index = {"timestamp": rows % 50 * 0.1, "episode_index": rows // 50, "frame_index": rows % 50}
        features |= {name: {"dtype": str(array.dtype), "shape": [1], "names": None} for name, array in index.items()}
        features["observation.images.wrist"] = {"dtype": "video", "shape": [8, 8, 3], "names": None}
        table = {name: array.astype(dtype).tolist() for name, array in values.items()} | index
        for folder in ("meta", "data/chunk-000"):
            (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        (tmp_path / "meta/info.json").write_text(json.dumps({"features": features}))
        parquet.write_table(pyarrow.table(table), tmp_path / "data/chunk-000/file-000.parquet")
        return tmp_path

    return write


def test_names_of_features_and_episodes_as_parts(write_dataset, info):
    folder = write_dataset()
    names = read_dataset_header(folder).names
    assert names[:4] == (
        "action.shoulder.pos",
        "action.elbow.pos",
        "observation.state.shoulder.pos",
        "observation.state.elbow.pos",
    )
    assert not any("images" in name for name in names)
    log = read_robot_log(folder, info)
    assert log.signals.observations[3] == pytest.approx([3.0, 3.1, 3.2, 3.3, 3.4])
    assert log.signals.actions[3] == pytest.approx([3.5, 3.6])
    assert log.signals.lengths == (50, 50)
    assert log.row(60) == 60


def test_joints_in_another_order(write_dataset, info):
    log = read_robot_log(write_dataset(names=NAMES[::-1]), info)
    assert log.signals.observations[3, :2] == pytest.approx([3.1, 3.0])


def test_the_whole_observation_without_names(write_dataset, info):
    """`rlctl export --dataset lerobot` writes it so."""
    state = np.arange(500.0).reshape(100, 5)
    log = read_robot_log(write_dataset(None, state), info)
    assert log.signals.observations[3] == pytest.approx([15.0, 16.0, 17.0, 18.0, 19.0])
    assert log.signals.actions[3] == pytest.approx([3.5, 3.6])


def test_units_of_columns(write_dataset, info, tmp_path):
    file = tmp_path / "columns.yaml"
    file.write_text(f"scale: {{joint_positions: {math.pi / 180}, actions: [1, 2]}}\noffset: {{joint_positions: 0.5}}\n")
    log = read_robot_log(write_dataset(), info, file)
    # 90 degrees are pi / 2, and the offset is in radians.
    assert log.signals.observations[90, 0] == pytest.approx(math.pi / 2 + 0.5)
    assert log.signals.observations[90, 2] == pytest.approx(90.2)
    assert log.signals.actions[3] == pytest.approx([3.5, 7.2])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scale: {joint_position: 2}", "scale and offset are of observations and actions, not of 'joint_position'"),
        ("offset: {goal: [1, 2]}", "offset: goal has 3 elements, and 2 are given"),
    ],
)
def test_units_that_do_not_fit(write_dataset, info, tmp_path, text, message):
    (tmp_path / "columns.yaml").write_text(text)
    with pytest.raises(ArtifactError, match=message):
        read_robot_log(write_dataset(), info, tmp_path / "columns.yaml")


def test_names_that_do_not_fit(write_dataset, info):
    message = r"meta/info\.json: action has 2 numbers and 1 different names; give each a name, or none"
    for names in (["shoulder.pos"], ["shoulder.pos", "shoulder.pos"]):
        with pytest.raises(ArtifactError, match=message):
            read_robot_log(write_dataset(names), info)


def test_missing_names(write_dataset, info):
    message = r"2 elements, and there are 4 columns, observation\.state_0 to .*\n.*names: --columns FILE"
    with pytest.raises(ArtifactError, match=message):
        read_robot_log(write_dataset(None, np.zeros((100, 4))), info)


def test_what_is_not_a_number(write_dataset, info):
    state = np.column_stack([np.arange(100.0)] * 2)
    state[7, 1] = np.nan
    with pytest.raises(ArtifactError, match=r"row 7, column observation\.state\.elbow\.pos: nan is not a finite"):
        read_robot_log(write_dataset(state=state), info)


def test_a_folder_that_is_no_dataset(tmp_path, info):
    with pytest.raises(ArtifactError, match=r"not a log that diagnose reads: give .* the folder of a LeRobot dataset"):
        read_robot_log(tmp_path, info)


def test_without_the_extra(write_dataset, info, monkeypatch):
    folder = write_dataset()
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match=r"^diagnose .* needs pyarrow: pip install .*\[demos\]"):
        read_robot_log(folder, info)
