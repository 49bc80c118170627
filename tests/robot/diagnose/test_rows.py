"""Rows in which the robot moves are chosen more often than those in which it rests."""

import numpy as np
import pytest

from rlctl_robot.diagnose.candidates import TermStatistics
from rlctl_robot.diagnose.rows import choose_rows
from rlctl_robot.diagnose.signals import LoggedSignals

STATISTICS = {"q": TermStatistics(np.zeros(1), np.ones(1))}


def make_signals(values):
    return LoggedSignals(np.array(values, float)[:, None], np.zeros((len(values), 1)), (len(values),), {"q": 1})


def test_an_arm_that_moves_and_then_rests():
    # 0.05 standard deviations a row in the first 108 rows, then nothing: motion 0.8 or less against 0.02.
    signals = make_signals(np.minimum(np.arange(1016), 108) * 0.05)
    chosen = choose_rows(signals, np.arange(8, 1008), STATISTICS, 100)
    assert (chosen.rows < 108).sum() > 75
    assert 100 < chosen.stands_for < 200  # of 1000


def test_a_log_that_always_moves_stands_for_all_of_its_rows():
    chosen = choose_rows(make_signals(np.arange(216) * 0.05), np.arange(8, 208), STATISTICS, 50)
    assert chosen.stands_for == pytest.approx(200)
    assert len(chosen.rows) == 50
    assert np.ptp(np.diff(chosen.rows)) <= 1
