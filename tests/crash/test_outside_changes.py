"""Files that are removed, edited or not writable while a training goes on, and a clock that jumps."""

import shutil

import pytest

from rlctl.training import checkpoint_file
from tests.crash.contract import assert_quiet, assert_same_end
from tests.crash.outside_changes import CLOCKS
from tests.crash.trials import ARGUMENTS, only_run, resume
from tests.training.comparing import rows

pytestmark = pytest.mark.crash

NAME = "ppo, kept"  # boundaries at 16, 32, 48, 64 and 80; evaluations at 32, 64 and 80
AFTER = 48


@pytest.fixture
def change(trials, folders):
    """Train while something happens after a step; return how it ended, its run, and the warnings."""

    def run(what, name=NAME, **plan):
        ended = trials.run(ARGUMENTS[name], next(folders), outside_change={"what": what, "after": AFTER, **plan})
        assert_quiet(ended)
        assert ended.code == 0, ended.stderr
        warnings = [line for line in ended.stderr.splitlines() if line.startswith(("warning", "saved again"))]
        return ended, only_run(ended.folder), warnings

    return run


def steps(file):
    return [int(row["steps"]) for row in rows(file)]


def assert_same_learnt(run, whole):
    """Hold that the last checkpoints are the same; of tables and files there may be less."""
    (ours, damage), (theirs, _) = checkpoint_file.read_newest(run), checkpoint_file.read_newest(whole)
    assert damage == []
    assert ours.state.step == theirs.state.step
    for name, values in ours.tensors.items():
        assert values.tobytes() == theirs.tensors[name].tobytes(), name
    for file, other in ((run.best_policy, whole.best_policy), (run.last_policy, whole.last_policy)):
        assert file.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("what", ["run removed", "all runs removed"])
def test_a_run_that_is_removed_ends_its_training(trials, folders, what):
    ended = trials.run(ARGUMENTS[NAME], next(folders), outside_change={"what": what, "after": AFTER})
    assert_quiet(ended)
    assert ended.code == 5
    assert ended.stderr.splitlines()[-1].endswith(
        ": was removed during training, so nothing can be saved; start a new training"
    )
    assert only_run(ended.folder) is None


@pytest.mark.parametrize("what", ["event file removed", "lock removed", "episodes removed", "tensorboard removed"])
def test_what_is_removed_changes_nothing_else(whole, change, what):
    _, run, warnings = change(what)
    assert_same_end(run, only_run(whole(NAME).folder))
    assert warnings == []


@pytest.mark.parametrize(
    ("name", "what", "after"),
    [(NAME, "checkpoints removed", AFTER), ("sac, kept", "checkpoints removed", 32)],
)
def test_the_next_checkpoint_is_whole(trials, whole, change, name, what, after):
    ended, run, warnings = change(what, name, after=after)
    assert warnings == []
    assert_same_end(run, only_run(whole(name).folder))
    again = trials.run([*resume(run), "-n", "96"], ended.folder)
    assert again.code == 0, again.stderr
    saved, _ = checkpoint_file.read_newest(only_run(whole(name).folder))
    assert f"resuming at step {saved.state.step}, bit-exact" in again.stderr


@pytest.mark.parametrize(
    ("what", "left"),
    [
        ("metrics removed", [64, 80]),
        ("metrics emptied", [64, 80]),
        ("metrics longer", [16, 32, 48, 64, 80]),
        ("metrics sorted out", [64, 80]),
    ],
)
def test_a_changed_table_has_whole_rows_from_then_on(whole, change, what, left):
    _, run, warnings = change(what)
    before = only_run(whole(NAME).folder)
    assert warnings == []
    assert_same_learnt(run, before)
    ours, theirs = rows(run.metrics_file), rows(before.metrics_file)
    assert ours == [row for row in theirs if int(row["steps"]) in left]
    assert rows(run.evals_file) == rows(before.evals_file)


def test_evaluations_table_removed(whole, change):
    _, run, _ = change("evals removed")
    before = only_run(whole(NAME).folder)
    assert rows(run.evals_file) == rows(before.evals_file)[1:]
    assert rows(run.metrics_file) == rows(before.metrics_file)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("read-only", "Read-only file system"),
        ("full", "No space left on device"),
    ],
)
def test_a_disk_that_takes_nothing_for_a_while(whole, change, what, message):
    _, run, warnings = change(what, after=16, until=64)
    assert warnings[0].startswith("warning: not saved: ")
    assert warnings[0].endswith(f"{message}; training continues")
    assert warnings[-1] == "saved again, at step 64"
    assert_same_end(run, only_run(whole(NAME).folder))


def test_latest_is_not_ours_any_more(trials, whole, change):
    ended, run, _ = change("latest replaced", after=16)
    assert_same_end(run, only_run(whole(NAME).folder))
    assert (ended.folder / "runs" / "latest" / "mine").exists()
    assert trials.run(["train", "--resume", "latest"], ended.folder).code == 0


@pytest.mark.parametrize("what", CLOCKS)
def test_a_clock_that_jumps_changes_nothing(whole, change, what):
    _, run, warnings = change(what)
    assert warnings == []
    assert_same_end(run, only_run(whole(NAME).folder))


def test_latest_after_the_clock_was_set_back(trials, folders):
    folder = next(folders)
    short = [*ARGUMENTS[NAME], "-n", "16"]
    first = trials.run(short, folder)
    second = trials.run([*short, "--seed", "1"], folder, outside_change={"what": "clock back"})
    assert (first.code, second.code) == (0, 0)
    older, newer = sorted((folder / "runs" / "Line").iterdir(), reverse=True)
    assert (older.name[-2:], newer.name[-2:]) == ("s0", "s1")
    again = trials.run(["train", "--resume", "latest", "-n", "32"], folder)
    assert again.code == 0, again.stderr
    assert newer.name in again.stdout
    shutil.rmtree(newer)  # the link leads nowhere, and the time in the names decides
    again = trials.run(["train", "--resume", "latest", "-n", "32"], folder)
    assert older.name in again.stdout
