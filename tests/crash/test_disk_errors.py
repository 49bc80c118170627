"""A disk that does not do what it is asked for, once or from then on, at every operation."""

import pytest

from tests.crash.conftest import ALGORITHMS, PARTS, parts
from tests.crash.contract import assert_nothing_lost, assert_quiet, assert_same_end
from tests.crash.trials import ARGUMENTS, only_run

ERRORS = {"ENOSPC": "No space left on device", "EIO": "Input/output error", "EACCES": "Permission denied"}


def errors(part, operations, each=3):
    """Return the number of each operation, and an error, that a part tries: `each` of the errors by turns."""
    names = list(ERRORS)
    tried = [(at, names[(at + turn) % 3]) for at in range(1, operations + 2) for turn in range(each)]
    return tried[part :: each * PARTS]


@pytest.mark.crash
@parts(3)
@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_error_once_costs_nothing(trials, whole, folders, name, part):
    before = whole(name)
    for at, error in errors(part, before.operations):
        ended = trials.run(ARGUMENTS[name], next(folders), disk={"fault": error, "at": at})
        assert_quiet(ended)
        run = only_run(ended.folder)
        if ended.announced == 0:  # nothing had been done yet, and nothing is done
            assert ended.code == 5
            assert ERRORS[error] in ended.stderr
            continue
        assert ended.code == 0, ended.stderr
        assert_same_end(run, only_run(before.folder))


@pytest.mark.crash
@parts
@pytest.mark.parametrize("name", ALGORITHMS)
def test_short_writes_cost_nothing(trials, whole, folders, name, part):
    before = whole(name)
    for at in range(part or PARTS, before.operations + 1, PARTS):
        ended = trials.run(ARGUMENTS[name], next(folders), disk={"fault": "short", "at": at, "lasting": at % 2 == 0})
        assert_quiet(ended)
        assert ended.code == 0, ended.stderr
        assert "warning" not in ended.stderr
        assert_same_end(only_run(ended.folder), only_run(before.folder))


@pytest.mark.crash
@parts
@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_disk_that_has_failed_for_good(trials, whole, folders, name, part):
    before = whole(name)
    final = before.announced
    for at, error in errors(part, before.operations, each=1):
        disk = {"fault": error, "at": at, "lasting": True}
        ended = trials.run(ARGUMENTS[name], next(folders), disk=disk)
        assert_quiet(ended)
        assert ended.code == 5 or (ended.code == 0 and ended.announced == final), ended.stderr
        if any(line.startswith("fault ") for line in ended.log):
            assert ERRORS[error] in ended.stderr
        assert_nothing_lost(trials, ARGUMENTS[name], ended, only_run(before.folder))
