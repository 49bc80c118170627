"""Killed from outside, at any moment."""

import random
import signal

import pytest

from tests.crash.conftest import PARTS, parts
from tests.crash.contract import assert_nothing_lost
from tests.crash.envs import FILE
from tests.crash.trials import ARGUMENTS, only_run

KILLS = 100
STUCK = [f"{FILE}:Stuck" if each.endswith(":Line") else each for each in ARGUMENTS["ppo"]]


@parts
@pytest.mark.crash
def test_killed_at_any_moment(trials, whole, folders, part):
    for number in range(part, KILLS, PARTS):
        name = ("ppo", "sac")[number % 2]
        before = whole(name)
        # Real workers take longer to start than those of the run without faults.
        moment = random.Random(number).uniform(0.0, 2.0 * before.seconds + 0.5)
        ended = trials.run(ARGUMENTS[name], next(folders), real_workers=True, send=[[moment, signal.SIGKILL]])
        assert ended.code in (-signal.SIGKILL, 0), ended.stderr
        assert_nothing_lost(trials, ARGUMENTS[name], ended, only_run(before.folder))


@pytest.mark.slow
@pytest.mark.parametrize(
    "how", [*(pytest.param(how, marks=pytest.mark.crash) for how in ("asleep", "busy")), "in a library"]
)
def test_killed_while_the_workers_are_stuck(trials, tmp_path, how):
    (tmp_path / "stuck").write_text(how)
    ended = trials.run(STUCK, tmp_path, real_workers=True, cores=2, send=[["stuck.log", signal.SIGKILL]])
    assert ended.code == -signal.SIGKILL
    assert ended.orphans == []
    (tmp_path / "stuck").unlink()
    (run,) = tmp_path.glob("runs/Stuck/*")
    again = trials.run(["train", "--resume", str(run)], tmp_path)
    assert again.code == 0, again.stderr
    assert again.resumed_at >= ended.announced > 0
