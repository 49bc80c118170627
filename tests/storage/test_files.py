"""Files appear whole or not at all."""

import errno
import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from rlctl.errors import ArtifactError
from rlctl.storage import files


def test_a_write_that_fails_leaves_the_old_file_and_no_litter(tmp_path, monkeypatch):
    path = tmp_path / "policy.bin"
    files.write_bytes(path, b"old")

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space") as caught:
        files.write_bytes(path, b"new")
    assert caught.value.filename == str(path)  # and not the file beside it
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["policy.bin"]


@pytest.mark.parametrize("operation", ["write", "fsync"])
def test_errors_name_the_file_that_cannot_be_written(tmp_path, monkeypatch, operation):
    def fill(path):
        files.write_new(path / "state.npz", b"new")

    def write_folder(path):
        with files.whole_folder(path) as beside:
            fill(beside)

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    (tmp_path / "table.csv").write_bytes(b"old")
    monkeypatch.setattr(os, operation, full)
    for name, write in [
        ("policy.bin", lambda path: files.write_bytes(path, b"new")),
        ("checkpoint", write_folder),
        ("table.csv", lambda path: files.append(path, b"new", 0) if operation == "write" else files.truncate(path, 0)),
    ]:
        with pytest.raises(OSError, match="No space") as caught:
            write(tmp_path / name)
        assert caught.value.filename == str(tmp_path / name)


def test_a_writer_that_raises_leaves_the_old_file_and_no_litter(tmp_path):
    path = tmp_path / "recording.rrd"
    files.write_with(path, lambda beside: beside.write_bytes(b"old"))

    def half(beside):
        assert beside.suffix == ".rrd"
        beside.write_bytes(b"ha")
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        files.write_with(path, half)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["recording.rrd"]


def test_folders_are_made(tmp_path):
    files.write_text(tmp_path / "a" / "b" / "c.txt", "grün")
    assert (tmp_path / "a/b/c.txt").read_bytes() == "grün".encode()


def test_json(tmp_path):
    path = tmp_path / "run.json"
    files.write_json(path, {"steps": 3})
    assert json.loads(path.read_text()) == files.read_json(path) == {"steps": 3}
    path.write_text('{"steps": ')
    with pytest.raises(ArtifactError, match=r"run.json: damaged: Expecting value: line 1 column 11"):
        files.read_json(path)
    path.write_bytes(b"\xff")
    with pytest.raises(ArtifactError, match=r"run.json: damaged: 'utf-8' codec"):
        files.read_json(path)
    with pytest.raises(ArtifactError, match=r"other.json: no such file$"):
        files.read_json(tmp_path / "other.json")


def test_npz_round_trip(tmp_path):
    path = tmp_path / "x.npz"
    arrays = {"a/b": np.arange(6, dtype=np.uint8).reshape(2, 3), "text": np.array("grün"), "none": np.zeros((0, 4))}
    files.write_npz(path, arrays)
    read = files.read_npz(path)
    assert read.keys() == arrays.keys()
    for name, value in arrays.items():
        np.testing.assert_array_equal(read[name], value)
        assert read[name].dtype == value.dtype


def test_object_arrays_are_refused(tmp_path):
    path = tmp_path / "x.npz"
    with pytest.raises(ValueError, match="allow_pickle=False"):
        files.write_npz(path, {"a": np.array([{}], dtype=object)})
    assert os.listdir(tmp_path) == []
    np.savez(path, a=np.array([{}], dtype=object))
    with pytest.raises(ArtifactError, match=r"x.npz: damaged, or not an .npz file: Object arrays cannot be loaded"):
        files.read_npz(path)


@pytest.mark.parametrize("damage", ["truncated", "flipped", "text", "empty", "npy"])
def test_a_damaged_npz(tmp_path, damage):
    path = tmp_path / "x.npz"
    files.write_npz(path, {"a": np.arange(1000.0)})
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    damaged = {"truncated": content[:500], "flipped": content, "text": b"hello", "empty": b""}
    if damage == "npy":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    else:
        path.write_bytes(damaged[damage])
    with pytest.raises(ArtifactError, match=r"x.npz: damaged, or not an .npz file"):
        files.read_npz(path)


def test_a_missing_npz(tmp_path):
    with pytest.raises(ArtifactError, match=r"x.npz: no such file$"):
        files.read_npz(tmp_path / "x.npz")


def test_a_whole_folder(tmp_path):
    target = tmp_path / "checkpoints" / "000100"
    with files.whole_folder(target) as folder:
        files.write_new(folder / "a", b"1")
        assert not target.exists()
    assert os.listdir(target) == ["a"]
    with files.whole_folder(target) as folder:
        files.write_new(folder / "b", b"2")
    assert os.listdir(target) == ["b"]


def test_half_a_folder_is_taken_away(tmp_path):
    target = tmp_path / "000100"
    with files.whole_folder(target) as folder:
        files.write_new(folder / "a", b"1")

    def fill():
        with files.whole_folder(target) as folder:
            files.write_new(folder / "b", b"2")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fill()
    assert os.listdir(tmp_path) == ["000100"]
    assert os.listdir(target) == ["a"]


def test_appending_goes_on_at_the_given_size(tmp_path):
    path = tmp_path / "metrics.csv"
    files.append(path, b"a,b\n", 0)
    files.append(path, b"1,2\n", 4)
    files.append(path, b"3,4\n", 8)
    assert path.read_bytes() == b"a,b\n1,2\n3,4\n"


@pytest.mark.parametrize("there", [False, True])
def test_what_a_killed_process_left_is_put_right(tmp_path, there):
    (tmp_path / ".000100.old.part").mkdir()
    (tmp_path / ".000100.old.part" / "old").write_text("1")
    (tmp_path / ".000200.77.part").mkdir()
    (tmp_path / ".policy.77.part").write_text("half")
    if there:
        (tmp_path / "000100").mkdir()
    files.recover(tmp_path)
    # The folder that was set aside comes back, unless the one that takes its place is there.
    assert os.listdir(tmp_path) == ["000100"]
    assert os.listdir(tmp_path / "000100") == ([] if there else ["old"])


def test_a_tree_is_removed(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    files.remove_tree(tmp_path / "a")
    files.remove_tree(tmp_path / "a")
    assert os.listdir(tmp_path) == []


def test_changes_to_a_sealed_file_are_noticed(tmp_path):
    path = tmp_path / "recipe.yaml"
    files.write_sealed(path, "seed: 0\n")
    assert path.read_text().splitlines()[0] == "seed: 0"
    assert files.is_as_sealed(path)
    sealed = path.read_bytes()
    # Each single bit of it, and each length.
    for bit in range(8 * len(sealed)):
        flipped = bytearray(sealed)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        assert not files.is_as_sealed(path)
    for length in range(len(sealed)):
        path.write_bytes(sealed[:length])
        assert not files.is_as_sealed(path)


def test_the_root_of_all_folders_is_no_file():
    with pytest.raises(IsADirectoryError):
        files.write_bytes(Path("/"), b"")


def test_a_result_goes_into_a_pipe_and_through_a_link(tmp_path):
    pipe, link, target = tmp_path / "pipe", tmp_path / "link.json", tmp_path / "target.json"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    files.write_result(pipe, b"into the pipe")
    assert os.read(reader, 100) == b"into the pipe"
    os.close(reader)
    target.write_text("")
    link.symlink_to(target)
    files.write_result(link, b"behind the link")
    assert link.is_symlink()
    assert target.read_bytes() == b"behind the link"


def test_what_a_killed_process_left_is_removed_before_the_next_write(tmp_path):
    ended = subprocess.Popen(["true"])
    ended.wait()
    left, mine, other, fresh = (
        tmp_path / name
        for name in (
            f".{ended.pid}.part.film.mp4",
            f".{os.getpid()}.part.film.mp4",
            f".{ended.pid}.part.film2.mp4",
            f".{ended.pid + 100_000_000}.part.film.mp4",
        )
    )
    for path in (left, mine, other, fresh):
        path.write_bytes(b"part")
    for path in (left, mine, other):
        os.utime(path, (0, 0))
    files.remove_abandoned(tmp_path / "film.mp4")
    assert sorted(tmp_path.iterdir()) == sorted([mine, other, fresh])
