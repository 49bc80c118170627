"""The log of a server is rotated and counts repetitions; its Rerun recording."""

import json

import pytest

from rlctl.errors import ArtifactError
from rlctl.limits.bounds import SafetyEvent
from rlctl_robot.serve.records import EventLog
from tests.replaying.reading import column
from tests.robot.serve.serving import OBSERVATION, RunningServer, write_policy


def test_what_repeats_is_counted(tmp_path):
    log = EventLog(tmp_path / "log.jsonl")
    for _ in range(5):
        log.write_event(1, SafetyEvent(7.0, "limit", "elbow.speed", 2.0, 1.0))
        log.write_event(2, SafetyEvent(7.0, "limit", "elbow.speed", float("nan"), 1.0))
    log.write("state", 1, name="stopped")
    log.close()
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [(line["kind"], line["client"]) for line in lines] == [("limit", 1), ("limit", 2), ("state", 1)]
    assert lines[0]["value"] == 2.0
    assert lines[0]["time"] == "1970-01-01T00:00:07.000+00:00"


def test_files_are_rotated(tmp_path):
    log = EventLog(tmp_path / "log.jsonl", max_file_size=2000)
    for number in range(500):
        log.write("state", number, name="running")
    log.close()
    files = sorted(tmp_path.iterdir())
    assert [file.name for file in files] == ["log.jsonl", "log.jsonl.1", "log.jsonl.2", "log.jsonl.3"]
    assert all(file.stat().st_size <= 2000 for file in files)


def test_a_log_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ArtifactError, match="the log cannot be written"):
        EventLog(tmp_path / "file" / "log.jsonl")


def test_a_recording_for_rerun(tmp_path):
    file = write_policy(tmp_path / "policy.safetensors")
    server = RunningServer(file, watchdog=False, rerun=tmp_path / "served.rrd")
    with server.client() as client:
        for _ in range(5):
            client.ask(OBSERVATION)
    server.close()
    _, actions = column(tmp_path / "served.rrd", "/client_2/action", timeline="time")
    assert actions.tolist() == [[6.0, 1.0]] * 5
    _, goals = column(tmp_path / "served.rrd", "/client_2/observation/goal", timeline="time")
    assert goals.tolist() == [[1.0, 2.0, 3.0]] * 5
    _, limited = column(tmp_path / "served.rrd", "/client_2/limited", timeline="time")
    assert limited.tolist() == [[0.0]] * 5
    with pytest.raises(ArtifactError, match="the recording cannot be written"):
        RunningServer(file, rerun=file / "served.rrd")


def test_rows_in_which_the_robot_is_held_are_recorded(tmp_path):
    file = write_policy(tmp_path / "policy.safetensors")
    server = RunningServer(file, watchdog=False, rerun=tmp_path / "served.rrd")
    with server.client() as client:
        client.ask(OBSERVATION)
        client.ask({**OBSERVATION, "age_s": 1000.0})  # too old: the robot is held
    server.close()
    _, limited = column(tmp_path / "served.rrd", "/client_2/limited", timeline="time")
    assert limited.tolist() == [[0.0], [1.0]]
