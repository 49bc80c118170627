"""Archives and JSON that somebody may send: refused before they take memory, and nothing in them is run."""

import io
import json
import os
import pickle
import zipfile

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, UsageError
from rlctl.play.episode import EpisodeInfo, RecordedEpisode, load_episode, save_episode
from rlctl.runs.directory import RunDirectory, RunLock, is_being_written
from rlctl.runs.lookup import FoundPolicy, find_policy
from rlctl.storage import files, untrusted
from rlctl.storage.table import Table

INFO = EpisodeInfo(spec=EnvSpec("reach"), seed=1, total_reward=0.0, term_names=["distance"])


class Bait:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (os.mkdir, (str(self.path),))


@pytest.fixture
def episode(tmp_path):
    path = tmp_path / "000000.npz"
    rows = np.zeros((3, 2), np.float32)
    save_episode(path, RecordedEpisode(rows, np.zeros((4, 5), np.float32), np.zeros(3), np.zeros((3, 1)), INFO))
    return path


def array_file(array):
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def header(shape, descr="<f8"):
    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(content, {"shape": shape, "fortran_order": False, "descr": descr})
    return content.getvalue()


def archive(path, members, packing=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", packing) as target:
        for name, content in members:
            target.writestr(name, content)


@pytest.mark.parametrize("name", ["info", "actions", "observations", "rewards", "terms"])
def test_a_pickle_in_a_member(name, episode, tmp_path):
    arrays = files.read_npz(episode)
    bait = np.array([Bait(tmp_path / "sprung")], dtype=object)
    np.savez(episode, **{**arrays, name: bait})
    with pytest.raises(ArtifactError, match=r"000000.npz: damaged, or not an .npz file: Object arrays cannot be "):
        load_episode(episode)
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ([("evil.pkl", b"")], "'evil.pkl' is not an array, or its compression is not numpy's"),
        ([("a.npy", header((10**12,)) + b"\0" * 80)], "x.npz: damaged, or not an .npz file: "),
        ([("a.npy", header((-8,)))], "x.npz: damaged, or not an .npz file: "),
        ([("a.npy", header((11,)) + b"\0" * 80)], "EOF: reading array data, expected 88 bytes got 80"),
        ([("a.npy", b"\x93NUMPY\x09\x00" + b"\0" * 99)], "we only support format version"),
        ([("a.npy", b"not an array")], "'a' is not an array"),
        ([(f"{n}.npy", array_file(np.zeros(0))) for n in range(1001)], "it has 1,001 members, the limit is 1,000"),
    ],
)
def test_members_that_are_refused(members, message, tmp_path):
    path = tmp_path / "x.npz"
    archive(path, members)
    with pytest.raises(ArtifactError) as caught:
        files.read_npz(path)
    assert message in str(caught.value)
    assert caught.value.exit_code == 5
    assert [each.name for each in tmp_path.iterdir()] == ["x.npz"]


@pytest.mark.parametrize("name", ["../../x.npy", "/tmp/x.npy"])
def test_a_name_that_points_outside_is_only_a_name(name, tmp_path):
    archive(tmp_path / "x.npz", [(name, array_file(np.zeros(3)))])
    assert [each.shape for each in files.read_npz(tmp_path / "x.npz").values()] == [(3,)]
    assert [each.name for each in tmp_path.iterdir()] == ["x.npz"]


def test_packing_that_lets_a_file_choose_the_memory(tmp_path):
    archive(tmp_path / "x.npz", [("a.npy", array_file(np.zeros(3)))], zipfile.ZIP_LZMA)
    with pytest.raises(ArtifactError, match=r"'a.npy' is not an array, or its compression is not numpy's$"):
        files.read_npz(tmp_path / "x.npz")


def declaring(path, member, size):
    """Write an archive whose directory says that its only member is of `size` bytes once unpacked."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
        target.writestr("a.npy", member)
        target.filelist[0].file_size = size


def test_a_bomb_is_weighed_before_it_is_unpacked(tmp_path):
    path, start = tmp_path / "x.npz", header((2**40,))
    declaring(path, start + bytes(80), len(start) + 2**43)
    with pytest.raises(ArtifactError, match=r"x.npz: too large: unpacked it needs 8.8 TB of memory, and .* are free"):
        files.read_npz(path)


@pytest.mark.parametrize("size", [8, 2**20])
def test_an_archive_that_lies_of_its_size(size, tmp_path):
    path, start = tmp_path / "x.npz", header((size // 8,))
    declaring(path, start + bytes(32_000), len(start) + size)
    with pytest.raises(ArtifactError, match=r"x.npz: damaged, or not an .npz file: "):
        files.read_npz(path)


def test_an_honest_archive_of_pictures(tmp_path):
    """It is packed as well as a bomb: what counts is how much it takes, not how well it is packed."""
    path = tmp_path / "x.npz"
    files.write_npz(path, {"a": np.zeros((2000, 84, 84), np.uint8)})
    assert path.stat().st_size < 2000 * 84 * 84 / 500
    assert files.read_npz(path)["a"].shape == (2000, 84, 84)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rewards": np.zeros(2)}, "terms: float64 of shape (3, 1), not numbers of shape (2, 1)"),
        ({"rewards": np.array(1.0)}, "rewards: float64 of shape (), not numbers of shape (1,)"),
        ({"terms": np.zeros((3, 9))}, "terms: float64 of shape (3, 9), not numbers of shape (3, 1)"),
        ({"actions": np.array(["x"] * 3)}, "actions: <U1 of shape (3,), not numbers"),
        ({"actions": np.zeros((2, 2))}, "actions: float64 of shape (2, 2), not numbers of shape (3, 2)"),
        ({"actions": np.full((3, 2), np.nan)}, "actions are not all finite"),
        ({"observations": np.zeros((3, 5))}, "observations: float64 of shape (3, 5), not numbers of shape (4, 5)"),
        ({"observations": np.array(0.0)}, "observations: float64 of shape (), not numbers of shape (4,)"),
        ({"info": np.array("[" * 100_000)}, "damaged: nested too deeply"),
        ({"info": np.zeros((2, 2))}, "damaged: "),
    ],
)
def test_an_episode_whose_parts_do_not_fit(changes, message, episode):
    files.write_npz(episode, {**files.read_npz(episode), **changes})
    with pytest.raises(ArtifactError) as caught:
        load_episode(episode)
    assert message in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_an_episode_without_steps(episode):
    arrays = files.read_npz(episode)
    nothing = {name: arrays[name][:0] for name in ("actions", "rewards", "terms")}
    files.write_npz(episode, {**arrays, **nothing, "observations": arrays["observations"][:1]})
    with pytest.raises(ArtifactError, match=r"000000.npz: damaged: it has no steps$"):
        load_episode(episode)


@pytest.mark.slow_except("None", "1e+308")
@pytest.mark.parametrize("value", [None, -1, "x", [], {}, 10**30, 1e308])
def test_any_value_at_any_place_of_an_episode(value, episode):
    arrays, lines = files.read_npz(episode), []
    whole = json.loads(str(arrays["info"]))
    changed = [{**whole, key: value} for key in whole]
    changed += [{**whole, "spec": {**whole["spec"], key: value}} for key in whole["spec"]]
    for info in changed:
        files.write_npz(episode, {**arrays, "info": np.array(json.dumps(info))})
        try:
            load_episode(episode)
        except ArtifactError as error:
            lines.append(str(error))
    assert lines  # most values are refused, some are possible
    assert all(len(each.splitlines()) == 1 for each in lines)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[" * 100_000, "nested too deeply"),
        (b'{"a": ' * 100_000 + b"1" + b"}" * 100_000, "nested too deeply"),
        (b"[" * 101 + b"]" * 101, "nested too deeply"),
        (b'{"a": ' + b"9" * 10_000 + b"}", "Exceeds the limit"),
        (b"", "Expecting value"),
        (b"\xff\xfe{\x00}\x00", "'utf-8' codec can't decode byte 0xff"),
        (b"{\x00}", "Expecting property name"),
        (b'{"a": "\x00"}', "Invalid control character"),
    ],
)
def test_json_that_is_none(content, message, tmp_path):
    path = tmp_path / "run.json"
    path.write_bytes(content)
    with pytest.raises(ArtifactError) as caught:
        files.read_json(path)
    assert str(caught.value).startswith(f"{path}: damaged: ")
    assert message in str(caught.value)


@pytest.mark.parametrize("content", ["null", "[]", '"task"', "{}", '{"task": null}', '{"task": ["reach"]}'])
def test_a_run_that_names_no_task(content, tmp_path):
    (tmp_path / "run.json").write_text(content)
    with pytest.raises(ArtifactError, match=r"run.json: not a run of rlctl: it has no task$"):
        RunDirectory(tmp_path).status()


def test_json_that_is_too_large(tmp_path):
    path = tmp_path / "run.json"
    with path.open("wb") as file:
        file.truncate(10**9)  # takes no space on the disk
    with pytest.raises(ArtifactError, match=r"run.json: too large: 1.0 GB, the limit is 16.8 MB$"):
        files.read_json(path)


@pytest.mark.parametrize("suffix", [".json", ".npz", ".safetensors", ".onnx"])
@pytest.mark.parametrize("kind", ["pipe", "folder", "missing", "device"])
def test_what_is_no_file(kind, suffix, tmp_path):
    from rlctl import load_policy

    path = tmp_path / f"x{suffix}"
    make = {"pipe": os.mkfifo, "folder": os.mkdir, "device": lambda path: os.symlink("/dev/zero", path)}
    make.get(kind, lambda path: None)(path)
    readers = {".json": files.read_json, ".npz": load_episode}
    message = {"folder": "a folder, not a file", "missing": "no such file"}.get(kind, "a pipe or a device, not a file")
    with pytest.raises(ArtifactError) as caught:
        readers.get(suffix, load_policy)(path)
    assert str(caught.value) == f"{path}: {message}"


def test_a_policy_that_is_a_folder_is_not_called_missing(tmp_path):
    (tmp_path / "x.onnx").mkdir()
    assert find_policy(str(tmp_path / "x.onnx")) == FoundPolicy(tmp_path / "x.onnx", None)


@pytest.mark.parametrize("suffix", [".npz", ".safetensors", ".onnx"])
def test_a_pickle_with_another_name(suffix, tmp_path):
    from rlctl import load_policy

    path = tmp_path / f"x{suffix}"
    path.write_bytes(pickle.dumps(Bait(tmp_path / "sprung")))
    with pytest.raises(ArtifactError, match=r"damaged, or not an? "):
        (load_episode if suffix == ".npz" else load_policy)(path)
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("name", [".lock", "metrics.csv", "policies", "checkpoints/000000100"])
def test_a_run_with_a_link_out_of_it_is_not_written(name, tmp_path):
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    outside = tmp_path / "precious"
    outside.write_text("kept")
    (tmp_path / "run" / name).symlink_to(outside)
    with pytest.raises(ArtifactError, match=rf"{name}: a symbolic link out of the run's folder; remove it$"):
        RunDirectory(tmp_path / "run").lock()
    assert outside.read_text() == "kept"


def test_a_group_with_a_link_out_of_it_is_not_written(tmp_path):
    (tmp_path / "elsewhere_s0").mkdir()
    (tmp_path / "group").mkdir()
    (tmp_path / "group" / "x_s0").symlink_to(tmp_path / "elsewhere_s0")
    with pytest.raises(ArtifactError, match=r"x_s0: a symbolic link out of the group's folder; remove it$"):
        RunLock(tmp_path / "group", "group")


def test_a_lock_that_is_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / ".lock")
    assert not is_being_written(tmp_path)


@pytest.mark.parametrize("step", ["²", "9" * 5000, "-1", "../../x", ""])
def test_a_checkpoint_that_is_no_step(step, tmp_path):
    (tmp_path / "checkpoints" / "²").mkdir(parents=True)
    run = RunDirectory(tmp_path)
    assert run.checkpoints() == []
    with pytest.raises(UsageError, match=r": give best, last, or the step of a checkpoint$"):
        run.policy_file(step)


@pytest.mark.parametrize("name", ["..old.part", "...old.part"])
@pytest.mark.parametrize("make", [os.mkdir, lambda path: path.write_text("x")])
def test_an_old_part_of_nothing_is_removed(make, name, tmp_path):
    make(tmp_path / name)
    files.recover(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["pipe", "folder"])
def test_a_table_that_is_no_file(kind, tmp_path):
    {"pipe": os.mkfifo, "folder": os.mkdir}[kind](tmp_path / "evals.csv")
    with pytest.raises(ArtifactError, match=r"evals.csv: a (pipe or a device|folder), not a file$"):
        Table(tmp_path / "evals.csv")


def test_a_run_with_a_link_within_is_written(tmp_path):
    (tmp_path / "best").write_text("x")
    (tmp_path / "latest").symlink_to("best")
    (tmp_path / "itself").symlink_to("itself")
    RunDirectory(tmp_path).lock().release()


@pytest.mark.parametrize("name", ["policy.safetensors", "policy.onnx"])
def test_what_git_lfs_leaves_in_place_of_a_file(tmp_path, name):
    file = tmp_path / name
    file.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:aa\nsize 24000\n")
    with pytest.raises(ArtifactError, match=r"policy\.\w+: a pointer of Git LFS, not the file itself: git lfs pull$"):
        untrusted.check_safetensors(file) if name.endswith("s") else untrusted.read_bytes(file)
