"""Frozen sensors are found; contacts, saturated actions and pauses are none."""

import numpy as np

from rlctl_robot.diagnose.frozen import find_frozen
from rlctl_robot.diagnose.signals import LoggedSignals


def make_signals(column, lengths):
    return LoggedSignals(np.array(column, float)[:, None], np.zeros((len(column), 1)), lengths, {"q": 1})


MOVING = make_signals(np.sin(np.arange(400.0)), (200, 200))


def test_a_value_that_stays_to_the_end_is_frozen():
    values = np.sin(np.arange(100.0))
    values[40:] = 0.25
    (one,) = find_frozen(make_signals(values, (100,)), [MOVING])
    assert one.describe(1) == "q: element 0 is frozen at 0.25 from row 40 on, for 60 rows"


def test_a_pause_and_a_long_contact_are_not_frozen():
    values = np.sin(np.arange(100.0))
    values[20:60] = 0.25
    assert find_frozen(make_signals(values, (100,)), [MOVING]) == []
    # In simulation a foot touches the ground for 10 rows; here for the last 60, after a fall.
    contact = make_signals(np.arange(400) // 10 % 2, (200, 200))
    fallen = make_signals([*(np.arange(40) // 10 % 2), *np.ones(60)], (100,))
    assert find_frozen(fallen, [contact]) == []
    never = make_signals(np.zeros(400), (200, 200))
    assert find_frozen(make_signals(np.zeros(100), (100,)), [never]) == []


def test_a_robot_that_lies_still_has_no_frozen_sensor():
    sound = np.sin(np.arange(400.0))
    fallen = np.where(np.arange(100) < 40, np.sin(np.arange(100.0)), 0.25)

    def make_pair(first, second, lengths):
        return LoggedSignals(np.column_stack([first, second]), np.zeros((len(first), 1)), lengths, {"q": 1, "v": 1})

    reference = make_pair(sound, sound, (200, 200))
    assert find_frozen(make_pair(fallen, fallen, (100,)), [reference]) == []
    assert len(find_frozen(make_pair(fallen, np.sin(np.arange(100.0)), (100,)), [reference])) == 1


def test_an_end_stop_is_not_frozen():
    values = np.sin(np.arange(150.0) / 10)
    values[60:] = -1.2  # beyond all that the joint measured before
    assert find_frozen(make_signals(values, (150,)), [MOVING]) == []


def test_rest_in_simulation_does_not_hide_a_frozen_sensor():
    """At rest all sensors of a simulation keep their values, which is no reason to expect it while others move."""

    def make_pair(first, second, lengths):
        return LoggedSignals(np.column_stack([first, second]), np.zeros((len(first), 1)), lengths, {"q": 1, "v": 1})

    at_rest = np.where(np.arange(400) < 370, np.sin(np.arange(400.0)), 0.5)
    frozen = np.where(np.arange(200) < 40, np.sin(np.arange(200.0)), 0.25)
    (one,) = find_frozen(make_pair(frozen, np.sin(np.arange(200.0)), (200,)), [make_pair(at_rest, at_rest, (400,))])
    assert (one.term, one.first_row, one.rows) == ("q", 40, 160)
