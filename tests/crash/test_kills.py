"""Killed at every operation on the disk, before it, in the middle of it, by a power cut; and again while resuming."""

import signal

import pytest

from tests.crash.conftest import PARTS, parts
from tests.crash.contract import assert_nothing_lost, assert_tidy
from tests.crash.trials import ARGUMENTS, copied, only_run, operation_after, resume


def every(part, operations):
    """Return the numbers of the operations that a part tries, one more than there are among them."""
    return range(part or PARTS, operations + 2, PARTS)


# Takes seconds, and runs in every `make test`: a power failure leaves files that go on.
@parts
@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("ppo", "power"),
        *(pytest.param("ppo", fault, marks=pytest.mark.crash) for fault in ("kill", "half")),
        *(pytest.param("sac", fault, marks=pytest.mark.crash) for fault in ("kill", "half", "power")),
    ],
)
def test_killed_at_an_operation(trials, whole, folders, name, fault, part):
    before = whole(name)
    for at in every(part, before.operations):
        ended = trials.run(ARGUMENTS[name], next(folders), disk={"fault": fault, "at": at})
        assert ended.code == (-signal.SIGKILL if at <= before.operations else 0), ended.stderr
        assert_nothing_lost(trials, ARGUMENTS[name], ended, only_run(before.folder))
        assert_tidy(only_run(ended.folder))


@pytest.fixture(scope="session")
def half_done(trials, whole, tmp_path_factory):
    """A run that was killed in the middle of a checkpoint, by name and the step of the one before."""
    ended = {}

    def get(name, saved):
        key = (name, saved)
        if key not in ended:
            at = operation_after(whole(name), saved) + 12
            folder = tmp_path_factory.mktemp(f"half of {name}")
            ended[key] = trials.run(ARGUMENTS[name], folder, disk={"fault": "half", "at": at})
            assert ended[key].announced == saved
        return ended[key]

    return get


@parts
@pytest.mark.crash
@pytest.mark.parametrize(("name", "saved"), [("ppo", 16), ("ppo", 0), ("sac", 16)])
def test_killed_again_while_resuming(trials, whole, half_done, folders, name, saved, part):
    before = half_done(name, saved)
    first = next(folders)
    operations = trials.run(resume(copied(only_run(before.folder), first)), first).operations
    assert operations > 20
    for at in every(part, operations):
        folder = next(folders)
        run = copied(only_run(before.folder), folder)
        ended = trials.run(resume(run), folder, disk={"fault": "half", "at": at})
        assert ended.code == (-signal.SIGKILL if at <= operations else 0), ended.stderr
        assert_nothing_lost(trials, ARGUMENTS[name], ended, only_run(whole(name).folder), before.announced)
