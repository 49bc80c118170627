"""The log of a server: bounded, rotated, and repetitions counted."""

import json

import pytest

from rlctl.deploy.event_log import EventLog
from rlctl.errors import ArtifactError


def test_what_repeats_is_counted(tmp_path):
    log = EventLog(tmp_path / "log.jsonl")
    for _ in range(5):
        log.write("limit", 1, name="elbow.speed", value=2.0, limit=1.0)
        log.write("limit", 2, name="elbow.speed", value=float("nan"), limit=1.0)
    log.write("state", 1, name="stopped")
    log.close()
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [(line["kind"], line["client"]) for line in lines] == [("limit", 1), ("limit", 2), ("state", 1)]
    assert lines[0]["value"] == 2.0
    assert "T" in lines[0]["time"]


def test_files_are_rotated(tmp_path):
    log = EventLog(tmp_path / "log.jsonl", largest=2000)
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
