"""What is judged of environments whose steps take long."""

import pytest

from rlctl.checking.check import CheckReport, judge
from rlctl.checking.formats import to_text
from rlctl.checking.records import Finished, Records, Shortened
from rlctl.checking.rule_index import PROCESS_S
from tests.checking.judging import run_here

SLOW = """
import time
import gymnasium, numpy


class Slow(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1000.0, 1000.0, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count, self.place = 0, self.np_random.normal(size=1).astype(numpy.float32)
        return self.place, {}

    def step(self, action):
        until = time.perf_counter() + 0.0005
        while time.perf_counter() < until:
            pass
        self.count += 1
        self.place = self.place + action
        return self.place, float(-abs(self.place[0])), False, self.count >= 100, {}
"""


@pytest.fixture
def slow(tmp_path):
    (tmp_path / "slow_steps.py").write_text(SLOW)
    return f"{tmp_path}/slow_steps.py:Slow"


def play(task, experiments, seconds, most_growth):
    records = Records(task)
    process = "probe"
    names = ["build", *experiments]
    for message in run_here(process, task, names, seconds, most_growth=most_growth):
        records.add(message)
    return records


@pytest.mark.slow
def test_the_time_of_a_slow_environment_grows_while_it_is_played(slow):
    seconds = 0.15  # the comparisons take some 500 steps, which are 0.25 s
    assert play(slow, ["comparisons"], seconds, 1.0).finished["comparisons"].is_cut
    finished = play(slow, ["comparisons"], seconds, 5.0).finished["comparisons"]
    assert finished.is_complete
    assert not finished.is_cut
    # 1.3 * 14,000 steps of half a millisecond, and some resets
    assert 9.0 < finished.needed_s < 30.0


@pytest.mark.slow
def test_fewer_episodes_are_enough_for_a_slow_environment(slow):
    records = play(slow, ["episodes", "search"], 1.1, 1.0)  # half a second for 16 episodes of 0.05 s
    episodes = len(records.role("episodes"))
    assert 5 <= episodes < 16
    assert records.shortened == {"episodes": f"{episodes} of 16 episodes"}
    assert "RL502" in judge(records, ["RL502"]).judged


@pytest.mark.slow
def test_the_last_line_says_what_more_time_would_do(slow):
    records = play(slow, ["comparisons"], 0.15, 1.0)
    rules = ["RL301", "RL302"]
    report = CheckReport(slow, judge(records, rules), records, seconds=1.0, budget_s=PROCESS_S)
    lines = to_text(report).splitlines()
    assert lines[-1].startswith("not passed: 2 rules not judged for lack of time: --budget ")
    assert report.needed_budget >= 2 * PROCESS_S
    assert f"--budget {report.needed_budget} should judge them" in lines[-1]
    assert report.exit_code == 1


def test_what_was_shortened_is_named(slow):
    records = play(slow, [], 1.0, 1.0)
    records.add(Shortened("episodes", "12 of 16 episodes"))
    records.add(Finished("episodes", 1.0, is_complete=True))
    report = CheckReport(slow, judge(records, []), records, seconds=1.0, budget_s=PROCESS_S)
    assert "slow environment: judged on 12 of 16 episodes" in to_text(report).splitlines()
