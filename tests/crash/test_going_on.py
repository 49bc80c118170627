"""Runs that are gone on with, for longer, or when nothing is left to do."""

import dataclasses

import pytest

from rlctl.play.seeds import Stream, episode_seed
from tests.crash.contract import assert_quiet, assert_same_end
from tests.crash.trials import ARGUMENTS, only_run, resume

pytestmark = pytest.mark.crash

SEED = episode_seed(0, Stream.TRAIN, 1, 3)
"""Of the fourth episode of the second environment: its seventh step is the 37th, in the fifth rollout of eight."""

SDE = [*ARGUMENTS["ppo, kept"], "--set", "algo_kwargs.use_sde=true"]
# As long as one evaluation is the end of the shorter run: it would have one more otherwise.
LONGER = {
    "ppo": (ARGUMENTS["ppo, kept"], 64, 80),
    "ppo with gSDE": (SDE, 64, 80),
    "sac": (ARGUMENTS["sac, kept"], 32, 48),
}


@pytest.mark.parametrize("name", LONGER)
def test_a_finished_run_made_longer_is_a_longer_run(trials, folders, name):
    arguments, short, long = LONGER[name]
    whole = trials.run([*arguments, "-n", str(long)], next(folders))
    first = trials.run([*arguments, "-n", str(short)], next(folders))
    run = only_run(first.folder)
    longer = trials.run([*resume(run), "-n", str(long)], first.folder)
    assert [ended.code for ended in (whole, first, longer)] == [0, 0, 0]
    assert f"resuming at step {short}, bit-exact" in longer.stderr
    assert_same_end(run, only_run(whole.folder))


def contents(run):
    return {file: file.read_bytes() for file in run.path.rglob("*") if file.is_file() and file.name != ".lock"}


@pytest.mark.parametrize("more", [[], ["--stop-success", "0.98"]], ids=["all steps", "good enough"])
def test_a_finished_run_has_nothing_to_do(trials, folders, more):
    ended = trials.run([*ARGUMENTS["ppo"], *more, "-n", "320" if more else "48"], next(folders))
    assert ended.code == 0, ended.stderr
    run = only_run(ended.folder)
    assert run.status()["steps"] == (64 if more else 48)  # the second evaluation in a row, or the last step
    before = contents(run)
    again = trials.run(resume(run), ended.folder)
    assert_quiet(again)
    assert again.code == 0
    assert "this run has finished: nothing to do; to train longer, give -n" in again.stdout
    assert contents(run) == before


def test_killed_before_its_first_checkpoint(trials, whole, folders):
    before = whole("ppo")
    first = next(number for number, line in enumerate(before.log) if "000000000" in line)
    at = int(before.log[first].split()[1])
    ended = trials.run(ARGUMENTS["ppo"], next(folders), disk={"fault": "kill", "at": at})
    run = only_run(ended.folder)
    assert run.checkpoints() == []
    again = trials.run(resume(run), ended.folder)
    assert again.code == 0, again.stderr
    assert "no checkpoint yet: the training starts from step 0" in again.stderr
    assert_same_end(run, only_run(before.folder))


MENDABLE = f"""
from tests.training import envs
class Line(envs.Line):
    broken = True
    def step(self, action):
        if self.broken and self.np_random_seed == {SEED} and self.steps == 6:
            raise RuntimeError("the gripper fell off")
        return super().step(action)
"""


def test_an_environment_that_is_mended(trials, folders):
    folder = next(folders)
    folder.mkdir()
    file = folder / "mine.py"
    file.write_text(MENDABLE)
    arguments = ["train", f"{file}:Line", *ARGUMENTS["ppo, kept"][2:]]
    ended = trials.run(arguments, folder)
    assert ended.code == 3
    assert_quiet(dataclasses.replace(ended, stderr=ended.stderr.replace("Traceback", "")))
    run = only_run(folder)
    assert [int(each.name) for each in run.checkpoints()] == [32, 48, 64]
    file.write_text(MENDABLE.replace("broken = True", "broken = False"))
    refused = trials.run(resume(run), folder)
    assert refused.code == 2
    assert "mine.py has changed since the run began. The policy may no longer fit; " in refused.stderr
    forced = trials.run([*resume(run), "--force"], folder)
    assert forced.code == 0, forced.stderr
    assert "resuming at step 64, not bit-exact: " in forced.stderr
    whole = trials.run(arguments, next(folders))
    assert whole.code == 0, whole.stderr
    assert_same_end(run, only_run(whole.folder))  # what was mended had not happened yet
