"""Runs in trackers: in W&B's offline file, a real MLflow server on loopback, and Trackio's local store."""

import json
import os
import signal
import socket
import sqlite3
import struct
import subprocess
import sys
import threading
import time
import urllib.request

import pytest

import rlctl
from rlctl.errors import RecipeError, UsageError
from rlctl.launching import tracking
from rlctl.launching.seeds import train_seeds
from rlctl.runs.directory import RunDirectory
from rlctl.runs.train_request import TrainRequest
from rlctl.tuning.tune import tune
from rlctl.tuning.tune_request import TuneRequest
from tests.training.conftest import ENVS, SMALL_PPO

KEY = "0123456789abcdef0123456789abcdef01234567"
METRICS = {"train/loss", "rollout/ep_rew_mean", "eval/mean_reward", "eval/success_rate"}
SMALL = {**SMALL_PPO, "eval": {"episodes": 2, "every_steps": 128}}


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    """Trackers write into the current folder or the home folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("HOME", "WANDB_CACHE_DIR", "WANDB_DATA_DIR", "WANDB_CONFIG_DIR", "TRACKIO_DIR"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    monkeypatch.setenv("WANDB_API_KEY", KEY)
    monkeypatch.delenv("WANDB_BASE_URL", raising=False)


def read_wandb_file(path) -> list:
    """Return the records of a run file: blocks of 32 KiB with pieces of records, as LevelDB's log."""
    from wandb.proto.wandb_internal_pb2 import Record

    content, place, records, parts = path.read_bytes(), 7, [], b""
    assert content[:4] == b":W&B"
    while place + 7 <= len(content):
        _, length, kind = struct.unpack("<IHB", content[place : place + 7])
        parts += content[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):  # a whole record, or the last part of one
            records.append(Record.FromString(parts))
            parts = b""
        if 32768 - place % 32768 < 7:
            place += 32768 - place % 32768
    return records


def count_points(points) -> dict[str, list[int]]:
    """Return the steps of each metric, in order."""
    steps: dict[str, list[int]] = {}
    for step, name in points:
        steps.setdefault(name, []).append(step)
    return {name: sorted(values) for name, values in steps.items()}


def expect_whole(points, steps: list[int], evaluated: list[int]) -> None:
    """Each point of a training is there once."""
    counted = count_points(points)
    assert counted.keys() >= METRICS
    assert counted["train/loss"] == steps
    assert counted["eval/mean_reward"] == evaluated


def test_the_tracker_must_be_installed(train, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(UsageError, match=r"--track wandb needs wandb: pip install 'rlctl\[wandb\]'"):
        train("Line", {"track": "wandb"})
    with pytest.raises(UsageError, match="pip install"):
        train_seeds(TrainRequest(f"{ENVS}:Line", settings={"track": "wandb"}, root=tmp_path / "runs"), "0-1")
    assert not (tmp_path / "runs").exists()


def test_an_unknown_tracker_is_refused(train):
    with pytest.raises(RecipeError, match=r"track: expected .*wandb.* got 'wandbb'"):
        train("Line", {"track": "wandbb"})


@pytest.mark.slow  # 5 s
def test_a_resumed_run_is_one_run_in_wandb(train, resume, tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    run = train("Line", {**SMALL, "track": "wandb"}).run
    resume(RunDirectory(tmp_path / "runs" / "latest"), total_timesteps=384)
    files = sorted(tmp_path.glob("wandb/offline-run-*/*.wandb"))
    begins, points, artifacts = [], [], []
    for file in files:
        for record in read_wandb_file(file):
            if record.HasField("run"):
                begins.append(record.run)
            elif record.HasField("history"):
                values = {
                    ".".join([*item.nested_key]) or item.key: json.loads(item.value_json)
                    for item in record.history.item
                }
                points += [(values["steps"], name) for name in values if "/" in name]
            elif record.request.HasField("log_artifact"):
                artifacts.append(record.request.log_artifact.artifact.name)
            elif record.HasField("artifact"):
                artifacts.append(record.artifact.name)
    assert {(begin.run_id, begin.project, begin.display_name) for begin in begins} == {
        (run.id(), "Line", run.path.name)
    }
    config = {update.key: json.loads(update.value_json) for update in begins[0].config.update}
    assert config["algo_kwargs"]["n_steps"] == 16
    assert config["run"]["versions"]["torch"]
    expect_whole(points, [64, 128, 192, 256, 320, 384], [128, 256, 384])
    assert any("best" in name for name in artifacts)
    assert list(tmp_path.rglob("*.html")), "the report"
    expect_no_key(tmp_path)


def expect_no_key(folder) -> None:
    files = [file for file in folder.rglob("*") if file.is_file()]
    assert not [file for file in files if KEY.encode() in file.read_bytes()]


class Server:
    """An MLflow server with SQLite on this machine."""

    def __init__(self, folder) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.address = f"http://127.0.0.1:{self.port}"
        self.folder = folder

    def start(self) -> None:
        command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(self.port)]
        command += ["--workers", "1", "--backend-store-uri", f"sqlite:///{self.folder}/mlflow.db"]
        command += ["--artifacts-destination", str(self.folder / "artifacts")]
        with (self.folder / "server.log").open("a") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        deadline = time.monotonic() + 120
        while True:
            try:
                return urllib.request.urlopen(f"{self.address}/health", timeout=2).close()
            except OSError:
                assert time.monotonic() < deadline, (self.folder / "server.log").read_text()[-2000:]
                time.sleep(0.2)

    def stop(self) -> None:
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    pytest.importorskip("mlflow")
    server = Server(tmp_path_factory.mktemp("mlflow"))
    server.start()
    yield server
    server.stop()


@pytest.fixture
def mlflow(server, monkeypatch):
    """The client of a server, with the points of a run."""
    from mlflow import MlflowClient

    monkeypatch.setenv("MLFLOW_TRACKING_URI", server.address)
    return MlflowClient(server.address)


def find_runs(mlflow, filter=""):
    return mlflow.search_runs([mlflow.get_experiment_by_name("Line").experiment_id], filter)


def read_points(mlflow, run):
    return [
        (point.step, name) for name in run.data.metrics for point in mlflow.get_metric_history(run.info.run_id, name)
    ]


@pytest.mark.slow  # an MLflow server, two trainings
def test_seeds_are_grouped_in_mlflow(mlflow, tmp_path):
    request = TrainRequest(f"{ENVS}:Line", settings={**SMALL, "track": "mlflow"}, root=tmp_path / "runs", check=False)
    group = train_seeds(request, "3-4", episodes=2).score.group
    runs = find_runs(mlflow, f"tags.group = '{group.path.name}'")
    assert {run.data.params["seed"] for run in runs} == {"3", "4"}
    for run in runs:
        assert run.info.status == "FINISHED"
        assert run.data.params["algo_kwargs.n_steps"] == "16"
        assert run.data.params["run.versions.torch"]
        expect_whole(read_points(mlflow, run), [64, 128, 192, 256], [128, 256])
        files = {file.path for file in mlflow.list_artifacts(run.info.run_id)}
        assert files == {"recipe.yaml", "best.safetensors", "report.html"}


@pytest.mark.slow  # two tiny trainings of a robot, one with a film of the arm
def test_trials_are_grouped_and_a_film_is_sent_to_mlflow(mlflow, tmp_path):
    tiny = {"n_envs": 2, "algo_kwargs": {"n_steps": 32, "batch_size": 32}, "eval": {"episodes": 2, "every_steps": 64}}
    settings = {**tiny, "total_timesteps": 128, "track": "mlflow"}
    rlctl.train("reach", root=tmp_path / "runs", check=False, **settings)
    request = TuneRequest("reach", trials=2, search=["algo_kwargs.gamma=0.9:0.99"], root=tmp_path, settings=settings)
    tune(request)
    runs = mlflow.search_runs([mlflow.get_experiment_by_name("reach").experiment_id])
    alone = [run for run in runs if "group" not in run.data.tags]
    trials = [run for run in runs if "group" in run.data.tags]
    assert [{file.path for file in mlflow.list_artifacts(run.info.run_id)} for run in alone] == [
        {"recipe.yaml", "best.safetensors", "report.html", "film.mp4"}
    ]
    assert trials
    assert {run.data.tags["group"] for run in trials} == {folder.name for folder in tmp_path.glob("reach/*_tune")}


@pytest.mark.slow
def test_a_server_that_goes_away_costs_one_warning_and_no_point(
    server, mlflow, train, resume, tmp_path, monkeypatch, capfd
):
    monkeypatch.setattr(tracking, "_END_S", 200.0)  # for a busy machine

    def kill() -> None:
        while not list(tmp_path.glob("runs/Line/*/tracking.json")):
            time.sleep(0.05)
        server.stop()

    killer = threading.Thread(target=kill)
    killer.start()
    settings = {**SMALL, "total_timesteps": 12_800, "eval": {"episodes": 2, "every_steps": 6400}, "track": "mlflow"}
    settings["algo_kwargs"] = {**SMALL["algo_kwargs"], "n_epochs": 20}
    run = train("Line", settings).run
    killer.join()
    assert run.status()["status"] == "finished"
    assert capfd.readouterr().err.count("warning: not everything is sent to mlflow") == 1
    server.start()
    resume(run)
    (tracked,) = find_runs(mlflow, f"params.`run.id` = '{run.id()}'")
    assert tracked.info.status == "FINISHED"
    expect_whole(read_points(mlflow, tracked), list(range(64, 12_801, 64)), [6400, 12_800])


@pytest.mark.slow
def test_a_wrong_address_costs_one_warning_without_its_password(train, monkeypatch, capfd):
    pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://joe:{KEY}@127.0.0.1:1")
    assert train("Line", {**SMALL, "track": "mlflow"}).steps == 256
    output = capfd.readouterr().err
    assert output.count("warning: ") == 1
    assert "127.0.0.1" in output
    assert KEY not in output


@pytest.mark.slow
def test_a_missing_key_of_wandb_costs_one_warning(train, monkeypatch, capfd):
    monkeypatch.delenv("WANDB_API_KEY")
    assert train("Line", {**SMALL, "track": "wandb"}).steps == 256
    assert "not everything is sent to wandb: No API key configured" in capfd.readouterr().err


@pytest.mark.slow
def test_a_resumed_run_is_one_run_in_trackio(train, resume, tmp_path):
    pytest.importorskip(
        "trackio"
    )  # needs pillow < 13, so the environment of the tests has it only where that is chosen
    run = train("Line", {**SMALL, "track": "trackio"}).run
    resume(run, total_timesteps=384)
    with sqlite3.connect(tmp_path / "home" / "Line.db") as database:
        rows = database.execute("SELECT run_id, run_name, step, metrics FROM metrics").fetchall()
        configs = database.execute("SELECT config FROM configs").fetchall()
    assert {row[1] for row in rows} == {run.path.name}
    assert len({row[0] for row in rows}) == 1
    points = [(row[2], name) for row in rows for name in json.loads(row[3]) if "/" in name]
    expect_whole(points, [64, 128, 192, 256, 320, 384], [128, 256, 384])
    assert json.loads(configs[-1][0])["algo_kwargs"]["n_steps"] == 16
