"""`--on`, `RLCTL_ON` and `--cluster`."""

import pytest

from rlctl.cluster.executors import choose_cell_player, choose_executor
from rlctl.cluster.work import ClusterSettings, read_settings
from rlctl.errors import RecipeError, UsageError
from rlctl.launching.trainings import make_local_trainings


@pytest.mark.parametrize(
    ("on", "options", "message"),
    [
        ("sge", {}, "--on sge: give local, slurm, ray, ray:auto or ray:HOST:PORT"),
        ("local", {"detach": True}, "--detach is for --on slurm"),
        ("slurm", {"verb": "tune"}, "tune --on slurm: each trial depends on the results of earlier ones"),
    ],
)
def test_executors_that_do_not_exist(on, options, message):
    with pytest.raises(UsageError, match=message):
        choose_executor(on, **options)


def test_the_variable_replaces_the_default(monkeypatch):
    assert choose_executor(None) is make_local_trainings
    assert choose_cell_player(None) is None
    monkeypatch.setenv("RLCTL_ON", "slurm")
    assert choose_executor(None).func.__name__ == "SlurmTrainings"
    assert choose_executor("local") is make_local_trainings
    with pytest.raises(
        UsageError,
        match="eval --on slurm: a cell takes seconds, less than a job waits in SLURM's queue; give ray or local",
    ):
        choose_cell_player(None)


def test_settings_come_from_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cluster.yaml").write_text("cpus: 3\n")
    (tmp_path / "other.yaml").write_text("cpus: 4\nretries: 1\n")
    assert choose_executor("slurm").keywords["settings"].cpus == 3
    assert choose_executor("slurm", tmp_path / "other.yaml").keywords["settings"].retries == 1
    (tmp_path / "other.yaml").write_text("cpu: 4\n")
    with pytest.raises(RecipeError, match="cpu"):
        choose_executor("slurm", tmp_path / "other.yaml")


def test_on_without_cells_or_seeds_is_an_error(rlctl):
    for push in ([], ["--push"]):
        done = rlctl("eval", "reach", "--on", "ray", *push)
        assert (done.returncode, done.stderr) == (2, "error: --on needs a robustness map: give --vary too\n")
    assert "--jobs, --on and --detach need several seeds" in rlctl("train", "reach", "--on", "ray").stderr


def test_settings_that_are_comments_alone(tmp_path):
    (tmp_path / "cluster.yaml").write_text("# cpus: 4\n")
    assert read_settings(tmp_path / "cluster.yaml") == ClusterSettings()
