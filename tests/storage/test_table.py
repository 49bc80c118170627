import errno
import os

import pytest

from rlctl.storage import files
from rlctl.storage.table import Table


@pytest.fixture
def table(tmp_path):
    return Table(tmp_path / "metrics.csv")


def add(table, row):
    table.add(row)
    table.flush()


class FullDisk:
    """Takes `room` bytes of each write, and none after that."""

    def __init__(self, room):
        self.room = room

    def __getattr__(self, name):
        return getattr(os, name)

    def write(self, descriptor, content):
        if self.room == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        taken, self.room = os.write(descriptor, content[: self.room]), 0
        return taken


def test_rows_under_a_header(table):
    add(table, {"steps": 64, "success": None})
    add(table, {"steps": 128, "success": 0.5})
    assert table.path.read_text() == "steps,success\n64,\n128,0.5\n"
    assert table.size == len("steps,success\n64,\n128,0.5\n")


def test_going_on_with_a_table_that_is_there(table):
    add(table, {"steps": 64, "success": 1})
    again = Table(table.path)
    add(again, {"success": 0, "steps": 128, "new": 3})
    assert table.path.read_text() == "steps,success\n64,1\n128,0\n"


def test_cutting_back(table):
    add(table, {"steps": 64})
    size, sha256 = table.size, table.digest()
    add(table, {"steps": 128})
    again = Table(table.path)
    assert again.cut_back(size, sha256, 64)
    add(again, {"steps": 128})
    assert table.path.read_text() == "steps\n64\n128\n"
    assert not Table(table.path).cut_back(10_000, sha256, 128)
    assert table.path.read_text() == "steps\n64\n128\n"


def test_a_table_that_was_edited_keeps_its_whole_rows(table):
    """An editor on Windows: each line is a byte longer, so that the size ends in the middle of one."""
    add(table, {"steps": 64, "success": 0.5})
    add(table, {"steps": 128, "success": 0.25})
    size, sha256 = table.size, table.digest()
    add(table, {"steps": 192, "success": 1})
    table.path.write_bytes(table.path.read_bytes().replace(b"\n", b"\r\n") + b"a note\r\n19")
    again = Table(table.path)
    assert not again.cut_back(size, sha256, 128)
    add(again, {"steps": 192, "success": 1})
    assert table.path.read_bytes() == b"steps,success\n64,0.5\n128,0.25\n192,1\n"


@pytest.mark.parametrize("room", [0, 1, 3])
def test_a_full_disk_leaves_no_half_row_and_loses_none(table, monkeypatch, room):
    add(table, {"steps": 64})
    monkeypatch.setattr(files, "os", FullDisk(room))
    for steps in (128, 192):
        with pytest.raises(OSError, match="No space left"):
            add(table, {"steps": steps})
    assert table.path.read_text() == "steps\n64\n"
    monkeypatch.undo()
    table.flush()
    assert table.path.read_text() == "steps\n64\n128\n192\n"


def test_a_half_row_that_could_not_be_cut_back_is_written_over(table):
    add(table, {"steps": 64})
    with table.path.open("a") as file:
        file.write("12,half a row,")
    add(table, {"steps": 128})
    assert table.path.read_text() == "steps\n64\n128\n"


def test_a_file_that_was_removed_begins_anew(table):
    add(table, {"steps": 64})
    table.path.unlink()
    add(table, {"steps": 128})
    assert table.path.read_text() == "steps\n128\n"


def test_the_digest_is_of_the_rows_and_nothing_after_them(table):
    assert table.digest() == files.digest(b"")
    add(table, {"steps": 64})
    before = table.digest()
    assert before == files.digest(b"steps\n64\n")
    with table.path.open("a") as file:
        file.write("12,half a row")
    assert table.digest() == before
    table.path.write_text("steps\n65\n")
    assert table.digest() != before
