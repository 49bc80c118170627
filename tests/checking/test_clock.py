"""Time limits run on a clock that stands still while a process waits for a processor."""

import time
from pathlib import Path

import pytest

from rlctl.checking.check import judge
from rlctl.checking.progress import read_clock, read_clock_of
from rlctl.checking.records import Records
from rlctl.checking.rule_index import PROCESSES
from tests.checking.judging import FOLDER, found, run_here

LINUX = pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="only Linux counts it")


def test_waiting_for_something_else_counts():
    before, begun = read_clock(), time.monotonic()
    time.sleep(0.3)
    # The count of what does not count is not read at the same moment, and a busy machine may interrupt in between.
    assert 0.15 <= read_clock() - before <= time.monotonic() - begun + 0.1


@LINUX
def test_waiting_for_a_processor_does_not_count(busy):
    before, begun = [read_clock_of(child.pid) for child in busy], time.monotonic()
    time.sleep(0.6)
    spent = [read_clock_of(child.pid) - then for child, then in zip(busy, before, strict=True)]
    assert sum(spent) < 2 * (time.monotonic() - begun)  # one processor for three: each has a third of it, or less


@pytest.mark.slow
def test_what_the_clock_cut_off_is_not_judged():
    """As in `NothingHappens`, what never happened is a finding only of experiments that came to their end."""
    of_absence = {"RL110", "RL501", "RL611", "RL612"}
    assert {rule for rule, _ in found("broken_repeats.py:NothingHappens", *of_absence)} == of_absence
    records, names = Records("slow"), PROCESSES["probe"]
    for message in run_here("probe", f"{FOLDER}/broken_repeats.py:NothingHappensSlowly", names, 0.5):
        records.add(message)
    verdict = judge(records)
    assert not {finding.rule for finding in verdict.findings} & of_absence
    assert of_absence <= verdict.not_judged.keys()
    assert "time" in verdict.not_judged["RL611"]


@pytest.mark.pybullet
def test_no_call_begins_when_the_time_of_the_process_is_over(tmp_path):
    """An experiment without a look at the clock ends, too; the rules that one step decides come first."""
    resets = tmp_path / "resets"
    file = tmp_path / "slow_ball.py"
    file.write_text(
        "import sys, time\n"
        f"sys.path.append({str(FOLDER)!r})\n"
        "from broken_repeats import RL401RL808SharedWorld\n"
        "class Slow(RL401RL808SharedWorld):\n"
        "    def start(self):\n"
        f"        open({str(resets)!r}, 'a').write('.')\n"
        "        time.sleep(0.2)\n"
        "        super().start()\n"
    )
    records = Records("slow")
    for message in run_here("instances", f"{file}:Slow", PROCESSES["instances"], 1.5):
        records.add(message)
    assert len(resets.read_text()) <= 1.5 / 0.2 + 2
    assert "RL808" in {finding.rule for finding in records.findings}
    assert {"unseeded", "worlds"} & records.skipped.keys()
