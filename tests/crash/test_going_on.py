"""Runs that are gone on with, for longer, or when nothing is left to do."""

import pytest

from tests.crash.contract import assert_quiet, assert_same_end
from tests.crash.trials import ARGUMENTS, only_run, resume

SDE = [*ARGUMENTS["ppo, kept"], "--set", "algo_kwargs.use_sde=true"]
# As long as one evaluation is the end of the shorter run: it would have one more otherwise.
LONGER = {
    "ppo": (ARGUMENTS["ppo, kept"], 64, 80),
    "ppo with gSDE": (SDE, 64, 80),
    "sac": (ARGUMENTS["sac, kept"], 32, 48),
}


@pytest.mark.parametrize("name", LONGER)
def test_a_finished_run_made_longer_is_a_longer_run(server, folders, name):
    arguments, short, long = LONGER[name]
    whole = server.run([*arguments, "-n", str(long)], next(folders))
    first = server.run([*arguments, "-n", str(short)], next(folders))
    run = only_run(first.folder)
    longer = server.run([*resume(run), "-n", str(long)], first.folder)
    assert [ended.code for ended in (whole, first, longer)] == [0, 0, 0]
    assert f"going on at step {short}, as if it had never stopped" in longer.stderr
    assert_same_end(run, only_run(whole.folder))


def contents(run):
    return {file: file.read_bytes() for file in run.path.rglob("*") if file.is_file() and file.name != ".lock"}


@pytest.mark.parametrize("more", [[], ["--stop-success", "0.98"]], ids=["all steps", "good enough"])
def test_a_finished_run_has_nothing_to_do(server, folders, more):
    ended = server.run([*ARGUMENTS["ppo"], *more, "-n", "320" if more else "48"], next(folders))
    assert ended.code == 0, ended.stderr
    run = only_run(ended.folder)
    assert run.status()["steps"] == (64 if more else 48)  # the second evaluation in a row, or the last step
    before = contents(run)
    again = server.run(resume(run), ended.folder)
    assert_quiet(again)
    assert again.code == 0
    assert "this run is finished already: nothing to do; -n makes it longer" in again.stdout
    assert contents(run) == before


def test_killed_before_its_first_checkpoint(server, whole, folders):
    before = whole("ppo")
    first = next(number for number, line in enumerate(before.log) if "000000016" in line)
    at = int(before.log[first].split()[1])
    ended = server.run(ARGUMENTS["ppo"], next(folders), disk={"fault": "kill", "at": at})
    run = only_run(ended.folder)
    assert run.checkpoints() == []
    again = server.run(resume(run), ended.folder)
    assert again.code == 0, again.stderr
    assert "no checkpoint yet: the training begins at its first step" in again.stderr
    assert_same_end(run, only_run(before.folder))
