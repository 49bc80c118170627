"""`rlctl export RUN --dataset`: what is written is what `--demos` reads, and what the libraries' own readers read."""

import json
import sys

import minari
import numpy as np
import pyarrow.parquet
import pytest

from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, UsageError
from rlctl.exporting.dataset import export_dataset
from rlctl.exporting.export_request import ExportRequest
from rlctl.training.demonstrations import read_demonstrations
from tests.evaluation.conftest import write_run
from tests.training.conftest import ENVS

LINE = f"{ENVS}:Line"
ENV = describe(EnvSpec(LINE).make())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run whose policy takes the action 0; an episode has ten steps."""
    return write_run(tmp_path_factory.mktemp("line") / "run", f"{ENVS}:Line")


@pytest.fixture(scope="module")
def datasets(run):
    """A dataset of three episodes per format."""
    return {
        name: export_dataset(ExportRequest(str(run.path), dataset=name, episodes=3)) for name in ("minari", "lerobot")
    }


@pytest.mark.parametrize("name", ["minari", "lerobot"])
def test_demos_reads_what_was_exported(datasets, run, name):
    report = datasets[name]
    assert (report["path"].name, report["path"].parent.name) == (f"Line-{name}", "exports")
    assert (report["episodes"], report["steps"], report["successes"]) == (3, 30, 3)
    demonstrations = read_demonstrations(report["path"], LINE, ENV)
    assert [episode.actions.shape for episode in demonstrations] == [(10, 1)] * 3
    positions = np.stack([episode.observations[""] for episode in demonstrations])
    assert (positions == positions[:, :1]).all()  # the action 0 moves nothing
    assert (np.unique(positions).size, np.abs(positions).max() < 0.4) == (3, True)
    assert [episode.success for episode in demonstrations] == [True] * 3
    with pytest.raises(UsageError, match="exists already; give a new folder"):
        export_dataset(ExportRequest(str(run.path), dataset=name, episodes=1))


def test_minari_reads_it(datasets):
    dataset = minari.MinariDataset(datasets["minari"]["path"] / "data")
    assert (dataset.id, dataset.total_episodes, dataset.total_steps) == ("rlctl/Line-v0", 3, 30)
    episode = dataset[0]
    assert episode.observations.shape == (11, 1)
    np.testing.assert_allclose(episode.rewards, -np.abs(episode.observations[1:, 0]), rtol=1e-6)
    assert episode.truncations.tolist() == [False] * 9 + [True]
    assert not episode.terminations.any()


def test_lerobot_tables(datasets):
    """LeRobot 0.4.4 reads such a dataset: checked by hand, because it needs older versions of torch and Rerun."""
    folder = datasets["lerobot"]["path"]
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"]) == ("v3.0", 3, 30)
    assert info["features"]["observation.state"] == {"dtype": "float32", "shape": [1], "names": None}
    table = pyarrow.parquet.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0)).to_pydict()
    assert set(info["features"]) == set(table)
    assert table["frame_index"] == [*range(10)] * 3
    assert table["index"] == [*range(30)]
    assert table["next.done"] == ([False] * 9 + [True]) * 3
    episodes = pyarrow.parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert episodes["dataset_from_index"] == [0, 10, 20]
    assert episodes["dataset_to_index"] == [10, 20, 30]
    stats = json.loads((folder / "meta/stats.json").read_text())
    assert stats["frame_index"] == {
        "min": [0.0],
        "max": [9.0],
        "mean": [4.5],
        "std": [np.std(range(10))],
        "count": [30],
    }


@pytest.mark.parametrize(("name", "file"), [("minari", "main_data.hdf5"), ("lerobot", "file-000.parquet")])
def test_a_truncated_dataset(run, tmp_path, name, file):
    folder = export_dataset(ExportRequest(str(run.path), dataset=name, episodes=1, output=tmp_path / "data"))["path"]
    for table in folder.rglob(file):
        table.write_bytes(table.read_bytes()[:100])
    with pytest.raises(ArtifactError, match=f"^{folder}: damaged, or not a dataset: "):
        read_demonstrations(folder, LINE, ENV)


def test_a_minari_dataset_imports_nothing(datasets, run, tmp_path):
    folder = export_dataset(ExportRequest(str(run.path), dataset="minari", episodes=1, output=tmp_path / "data"))[
        "path"
    ]
    file = folder / "data/metadata.json"
    metadata = json.loads(file.read_text())
    del metadata["action_space"]  # then Minari would build the environment of env_spec
    file.write_text(json.dumps({**metadata, "env_spec": '{"id": "a-v0", "entry_point": "antigravity:x"}'}))
    with pytest.raises(ArtifactError, match=r"metadata\.json has no observation_space and action_space"):
        read_demonstrations(folder, LINE, ENV)


@pytest.mark.parametrize(("name", "package"), [("minari", "minari"), ("lerobot", "pyarrow")])
def test_without_the_extra(datasets, run, monkeypatch, tmp_path, name, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UsageError, match=f"--demos .* needs {package}: pip install"):
        read_demonstrations(datasets[name]["path"], LINE, ENV)
    with pytest.raises(UsageError, match=f"^--dataset {name} needs {package}: pip install"):
        export_dataset(ExportRequest(str(run.path), dataset=name, output=tmp_path / "new"))


@pytest.mark.slow
def test_the_command(rlctl, run):
    done = rlctl("export", run.path, "--dataset", "lerobot", "--episodes", "2", "-o", "data")
    assert done.stdout == "wrote data: lerobot, 2 episodes, 2 succeeded, 20 steps\n"
    refused = rlctl("export", run.path, "--dataset", "lerobot", "--c")
    assert refused.returncode == 2
    assert "--dataset writes only a dataset: leave out --onnx, --c, --controller and --policy" in refused.stderr
