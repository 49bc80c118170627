"""Reading the tables of LeRobot datasets: rows in the order of their episodes, and what is wrong in a line."""

import json

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from rlctl.errors import ArtifactError
from rlctl.storage import lerobot

FEATURES = {
    "action": {"dtype": "float32", "shape": [2], "names": ["pan.pos", "lift.pos"]},
    "observation.state": {"dtype": "float32", "shape": [2], "names": {"motors": ["pan", "lift"]}},
    "observation.images.wrist": {"dtype": "video", "shape": [3, 4, 4], "names": ["channel", "height", "width"]},
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
}


@pytest.fixture
def write_dataset(tmp_path):
    """Write a dataset of format v2.1, an episode of two rows per file: element k of row i is 10 i + k."""

    def write(features=FEATURES, **changes):
        (tmp_path / "meta").mkdir(exist_ok=True)
        (tmp_path / "meta/info.json").write_text(json.dumps({"codebase_version": "v2.1", "features": features}))
        (tmp_path / "data/chunk-000").mkdir(parents=True, exist_ok=True)
        for episode in (0, 1):
            rows = [20 * episode, 20 * episode + 10]
            columns = {
                "action": [[row, row + 1] for row in rows],
                "observation.state": pyarrow.array([[row, row + 1] for row in rows], pyarrow.list_(pyarrow.int64(), 2)),
                "timestamp": [0.0, 0.1],
                "episode_index": [episode] * 2,
                "frame_index": [0, 1],
            }
            table = pyarrow.table({**columns, **changes})
            parquet.write_table(table, tmp_path / f"data/chunk-000/episode_{1 - episode:06d}.parquet")
        return tmp_path

    return write


def read(folder, *names):
    features = lerobot.read_features(folder)
    return lerobot.read_rows(folder, [features[name] for name in names], "this")


def test_rows_come_in_the_order_of_episodes(write_dataset):
    folder = write_dataset()
    features = lerobot.read_features(folder)
    assert features["action"].element_names == ("pan.pos", "lift.pos")
    assert features["observation.state"].element_names == ("pan", "lift")
    assert [name for name, feature in features.items() if feature.is_picture] == ["observation.images.wrist"]
    rows = read(folder, "action", "observation.state", "timestamp")
    assert rows["episode_index"].tolist() == [0, 0, 1, 1]
    assert rows["action"].tolist() == [[0, 1], [10, 11], [20, 21], [30, 31]]
    np.testing.assert_array_equal(rows["observation.state"], rows["action"])
    assert rows["timestamp"].shape == (4, 1)


BAD = {
    "rows of other sizes": ({"action": [[1.0], [1.0, 2.0]]}, "action has rows of 1 and of 2 numbers"),
    "another size": ({"action": [[1.0], [2.0]]}, r"action has 1 numbers in a row, and 2 in meta/info\.json"),
    "no value": ({"action": [[1.0, 2.0], None]}, "action has rows without a value"),
    "no number": ({"episode_index": ["a", "b"]}, "episode_index has no numbers"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_tables(write_dataset, case):
    changes, message = BAD[case]
    folder = write_dataset(**changes)
    with pytest.raises(ArtifactError, match=f"^{folder}: damaged, or not a dataset: ValueError: {message}$"):
        read(folder, "action")


def test_a_column_that_is_missing(write_dataset):
    folder = write_dataset({**FEATURES, "effort": {"dtype": "float32", "shape": [2]}})
    with pytest.raises(ArtifactError, match=r"episode_000000\.parquet has no column 'effort'$"):
        read(folder, "effort")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "damaged, or not of a LeRobot dataset"),
        ("{}", "KeyError: 'features'"),
        ('{"features": [1]}', "damaged, or not of a LeRobot dataset"),
        ('{"features": {"action": {"dtype": "float32", "shape": [-1]}}}', r"feature action has the shape \[-1\]"),
    ],
)
def test_bad_descriptions(write_dataset, text, message):
    folder = write_dataset()
    (folder / "meta/info.json").write_text(text)
    with pytest.raises(ArtifactError, match=message):
        lerobot.read_features(folder)


def test_without_tables(write_dataset):
    folder = write_dataset()
    for file in folder.glob("data/*/*"):
        file.unlink()
    with pytest.raises(ArtifactError, match=r"no tables in it \(data/\*/\*\.parquet\)"):
        read(folder, "action")
