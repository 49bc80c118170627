"""The safety filter: limits by hand and for whatever goes in, faults, states, blends."""

import math

import hypothesis.extra.numpy as arrays
import hypothesis.strategies as st
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings

from rlctl.deploy import Limits, SafetyFilter
from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.errors import RecipeError, UsageError
from tests.limits.conftest import REPEATABLE, make_arm, make_filter, observe_at, run_filter

REST = observe_at(0.0, 0.0)


def test_speed_by_hand(arm):
    safety = make_filter(arm, command="position", limits={"all": {"speed": 2.0}})
    # 2 rad/s over 0.1 s are 0.2 rad; the second joint wants less.
    assert run_filter(safety, REST, [1.0, -0.1]) == pytest.approx([0.2, -0.1])
    assert run_filter(safety, REST, [1.0, -0.1]) == pytest.approx([0.4, -0.1])
    assert safety.counts == {"shoulder.speed": 2}
    last = safety.events[-1]
    assert (last.time_s, last.kind, last.name) == (7.0, "limit", "shoulder.speed")
    assert (last.value, last.limit) == pytest.approx((8.0, 2.0))  # (1 - 0.2) / 0.1


def test_acceleration_brakes_before_the_bound(arm):
    safety = make_filter(
        arm, command="position", limits={"all": {"acceleration": 5.0}, "shoulder": {"position": [-1, 0.3]}}
    )
    # A step may be 5 * 0.1^2 = 0.05 longer than the one before. Room is 0.3 = 0.05 + 0.1 + 0.1 + 0.05.
    moved = [run_filter(safety, REST, [9.0, 0.0])[0] for _ in range(6)]
    assert moved == pytest.approx([0.05, 0.15, 0.25, 0.3, 0.3, 0.3])


def test_events_have_the_units_of_their_limits(arm):
    limits = {"all": {"acceleration": 5.0}, "shoulder": {"position": [-1, 0.3]}}
    safety = make_filter(arm, command="position", limits=limits)
    for _ in range(3):
        run_filter(safety, REST, [9.0, 0.0])
    limited = [event for event in safety.events if event.kind == "limit"]
    assert [event.name.partition(".")[2] for event in limited] == [
        "acceleration",
        "acceleration",
        "acceleration",
        "position",
    ]
    # From rest 9 rad in a step of 0.1 s are 900 rad/s^2. The third step would lead to 0.15 + 0.15, and braking beyond.
    assert (limited[0].value, limited[0].limit) == pytest.approx((900.0, 5.0))
    assert (limited[3].value, limited[3].limit) == pytest.approx((0.3, 0.25))
    assert safety.find_last_events(2) == safety.events[-2:]
    assert safety.counts == {"shoulder.acceleration": 3, "shoulder.position": 1}


def test_steps_from_the_measured_position(arm):
    safety = make_filter(arm, command="step", scale=0.1, limits={"all": {"position": [-1, 1]}})
    # 2 of the action are 0.2 rad; from 0.9 only 0.1 are left, which are 1 of the action.
    assert run_filter(safety, observe_at(0.9, 0.0), [2.0, 2.0]) == pytest.approx([1.0, 2.0])
    assert run_filter(safety, observe_at(1.2, 0.0), [2.0, 2.0]) == pytest.approx([0.0, 2.0])  # beyond it only back
    assert run_filter(safety, observe_at(1.2, 0.0), [-2.0, 2.0]) == pytest.approx([-2.0, 2.0])


def test_speeds_are_accelerated_within_limits(arm):
    safety = make_filter(arm, command="speed", scale=2.0, limits={"all": {"acceleration": 10.0, "speed": 3.0}})
    # 1 of the action is 2 rad/s; 10 rad/s^2 over 0.1 s are 1 rad/s, 0.5 of the action; 3 rad/s are 1.5.
    actions = [run_filter(safety, REST, [9.0, 0.0])[0] for _ in range(4)]
    assert actions == pytest.approx([0.5, 1.0, 1.5, 1.5])
    safety.stop()
    assert [run_filter(safety, REST, [9.0, 0.0])[0] for _ in range(4)] == pytest.approx([1.0, 0.5, 0.0, 0.0])


def test_torques_and_their_rate(arm):
    safety = make_filter(arm, command="torque", scale=10.0, limits={"all": {"torque": 20.0, "rate": 100.0}})
    # 100 N m/s over 0.1 s are 10 N m, 1 of the action.
    assert [run_filter(safety, REST, [9.0, 0.0])[0] for _ in range(3)] == pytest.approx([1.0, 2.0, 2.0])


def test_lowpass_by_hand(arm):
    safety = make_filter(arm, command="action", lowpass_hz=1.0)
    part = 1 - math.exp(-2 * math.pi * 0.1)
    assert run_filter(safety, REST, [1.0, 0.0])[0] == pytest.approx(part)
    assert run_filter(safety, REST, [1.0, 0.0])[0] == pytest.approx(part + part * (1 - part))


def test_blend_in_begins_at_the_present_pose(arm):
    safety = make_filter(arm, command="position", blend_in_s=0.3)
    poses = [run_filter(safety, observe_at(1.0, 2.0), [2.0, 2.0])[0] for _ in range(5)]
    assert poses == pytest.approx([1.25, 1.5, 1.75, 2.0, 2.0])  # three steps on the way


def test_without_a_file_the_bounds_of_the_policy_hold():
    safety = SafetyFilter(make_arm(-1.0, 1.0))
    safety.observe(REST)
    assert safety.limit([3.0, -0.5]).tolist() == [1.0, -0.5]
    assert safety.counts == {"action[0].action": 1}


def test_a_fault_holds_until_it_ends(arm):
    safety = make_filter(arm, command="position", limits={"all": {"speed": 100}}, blend_in_s=0.1)
    for _ in range(3):
        moved = run_filter(safety, REST, [1.0, 1.0])
    held = run_filter(safety, observe_at(np.nan, 0.0), [5.0, 5.0])
    assert (safety.state, safety.reason) == ("holding", "positions[0] not finite")
    assert held.tolist() == moved.tolist() == [1.0, 1.0]
    assert run_filter(safety, REST, [2.0, 2.0]) == pytest.approx([1.5, 1.5])  # blended in again
    assert safety.state == "running"
    assert safety.counts == {"positions[0] not finite": 1}


@pytest.mark.parametrize(
    ("action", "fault"),
    [
        ([np.nan, 0.0], "invalid action"),
        ([np.inf, 0.0], "invalid action"),
        ([1.0], "invalid action"),
        (None, "no action"),
    ],
)
def test_a_policy_that_cannot_act_is_a_fault(arm, action, fault):
    safety = make_filter(arm, command="action", safe_action=[0.5, 0.0])
    assert run_filter(safety, REST, action).tolist() == [0.5, 0.0]
    assert safety.reason == fault
    run_filter(safety, REST, [1.0, 1.0])
    assert safety.state == "running"


def test_checks_of_sensors(arm):
    safety = make_filter(
        arm, command="action", on_fault="stop", sensors={"goal": {"range": [-1, 1]}, "positions": {"frozen_s": 0.2}}
    )
    assert safety.observe(observe_at(0.0, 0.0))
    assert safety.observe(observe_at(0.0, 0.0))
    assert not safety.observe(observe_at(0.0, 0.0))  # the same for 0.2 s
    assert safety.observe(observe_at(0.0, 0.1))
    assert not safety.observe(np.array([0, 0, 0, 1.5, 0], np.float32))
    assert not safety.observe(observe_at(0.0, 0.3), age_s=0.31)  # older than three periods
    assert not safety.observe(None)
    assert list(safety.counts) == ["positions frozen", "goal[1] out of range", "observation too old", "missing"]
    safety.limit(None)
    assert safety.state == "stopped"


def test_only_resume_ends_a_stop(arm):
    safety = make_filter(arm, command="position", home=[0.5, 0.5], limits={"all": {"speed": 1.0}})
    run_filter(safety, REST, [1.0, 1.0])
    safety.stop("button")
    safety.reset()
    for _ in range(2):
        assert run_filter(safety, REST, [1.0, 1.0]).tolist() == [0.0, 0.0]
    safety.hold()
    assert (safety.state, safety.reason) == ("stopped", "button")
    safety.resume()
    run_filter(safety, REST, [1.0, 1.0])
    assert safety.state == "running"
    safety.home()
    path = [run_filter(safety, REST, [-1.0, -1.0])[0] for _ in range(6)]
    assert path == pytest.approx([0.2, 0.3, 0.4, 0.5, 0.5, 0.5])
    assert [event.name for event in safety.events if event.kind == "state"] == [
        "running", "stopped", "idle", "running", "holding",
    ]  # fmt: skip


def test_an_override_of_choices_must_be_a_choice(arm):
    choices = arm.model_copy(update={"action_space": space_to_json(spaces.Discrete(3))})
    safety = SafetyFilter(choices)
    for action in ([3], [-1], [1.5]):
        with pytest.raises(ValueError, match=r"an action of Discrete\(3\)"):
            safety.override(action)
    safety.override([2])
    assert run_filter(safety, REST, 0) == 2


def test_an_override_begins_gradually_and_within_limits(arm):
    safety = make_filter(arm, command="position", blend_in_s=0.1, limits={"all": {"position": [-1, 1]}})
    for _ in range(3):
        run_filter(safety, REST, [0.5, 0.5])
    safety.override([3.0, 0.5])
    assert run_filter(safety, REST, [0.5, 0.5])[0] == pytest.approx(0.75)  # the bound is 1, half of the way 0.75
    assert run_filter(safety, REST, [0.5, 0.5])[0] == pytest.approx(1.0)
    safety.override(None)
    assert [run_filter(safety, REST, [0.5, 0.5])[0] for _ in range(2)] == pytest.approx([0.75, 0.5])
    with pytest.raises(ValueError, match=r"expected an action of Box\(.*, got \[1\.0\]"):
        safety.override([1.0])
    with pytest.raises(UsageError, match="the limits define no home"):
        safety.home()


def test_outside_its_limits_at_the_start(arm):
    safety = make_filter(arm, command="position", limits={"all": {"position": [-1, 1], "speed": 1.0}})
    assert run_filter(safety, observe_at(1.5, 0.0), [0.0, 0.0]).tolist() == [1.0, 0.0]
    assert (safety.state, safety.reason) == ("stopped", "shoulder is outside its limits at the start")


def test_the_difference_between_wanted_and_measured(arm):
    safety = make_filter(arm, command="position")
    run_filter(safety, REST, [0.5, 0.25])
    assert math.isnan(safety.control_error)
    run_filter(safety, observe_at(0.4, 0.25), [0.5, 0.25])
    assert safety.control_error == pytest.approx(0.1)


def test_choices_are_held_too():
    info = EnvInfo(
        observation_space=space_to_json(spaces.Box(-1, 1, (2,))),
        action_space=space_to_json(spaces.Discrete(3, start=5)),
    )
    safety = SafetyFilter(info)
    assert run_filter(safety, np.zeros(2), 7) == 7
    assert run_filter(safety, np.array([np.nan, 0.0]), 7) == 5
    for wrong in (8, 6.5, np.nan, 1e300, "no", 10**400):
        assert run_filter(safety, np.zeros(2), wrong) == 5
        assert (safety.state, safety.reason) == ("holding", "invalid action")
    with pytest.raises(UsageError, match="choices"):
        SafetyFilter(info, Limits.model_validate({"limits": {"all": {"action": [0, 1]}}}))


# For any input the output keeps every limit.

ACTIONS = st.one_of(
    arrays.arrays(np.float64, 2, elements=st.floats(width=64)),
    arrays.arrays(np.float64, 2, elements=st.floats(-3, 3)),
    arrays.arrays(np.float64, st.integers(0, 4)),
    st.none(),
)
POSITIONS = st.one_of(
    arrays.arrays(np.float32, 2, elements=st.floats(-0.5, 0.5, width=32)),
    arrays.arrays(np.float32, 2, elements=st.floats(width=32)),
)
ORDERS = st.sampled_from(["", "", "", "", "stop", "resume", "home", "hold", "reset", "hand", "policy"])
STEPS = st.lists(st.tuples(ACTIONS, POSITIONS, ORDERS), min_size=1, max_size=25)


def give_order(safety, order):
    if order in ("hand", "policy"):
        safety.override([2.0, -2.0] if order == "hand" else None)
    elif order:
        getattr(safety, order)()


@settings(REPEATABLE, max_examples=40)
@given(steps=STEPS, on_fault=st.sampled_from(["hold", "home", "stop"]), lowpass=st.sampled_from([None, 2.0]))
def test_positions_keep_every_limit(steps, on_fault, lowpass):
    limits = {"position": [-1.0, 0.8], "speed": 2.0, "acceleration": 6.0}
    safety = make_filter(
        make_arm(), command="position", limits={"all": limits}, home=[0.1, 0.2], on_fault=on_fault,
        lowpass_hz=lowpass, blend_in_s=0.2,
    )  # fmt: skip
    commands: list[np.ndarray] = []
    for action, positions, order in steps:
        if order == "reset" or (order == "resume" and safety.state == "stopped"):
            commands.clear()  # the next command begins at the measured positions
        give_order(safety, order)
        out = run_filter(safety, observe_at(*positions), action)
        assert out.dtype == np.float32
        assert out.shape == (2,)
        assert (out >= -1.0 - 1e-6).all()
        assert (out <= 0.8 + 1e-6).all()
        if np.isfinite(positions).all() or commands:  # before that nobody knows where it is
            commands.append(out.astype(np.float64))
    moved = np.diff(commands, axis=0) if commands else np.zeros((0, 2))
    assert (np.abs(moved) <= 0.2 + 1e-5).all()  # 2 rad/s over 0.1 s
    assert (np.abs(np.diff(moved, axis=0)) <= 0.06 + 1e-5).all()  # 6 rad/s^2 over 0.1 s twice


@settings(REPEATABLE, max_examples=40)
@given(steps=STEPS, on_fault=st.sampled_from(["hold", "home", "stop"]), lowpass=st.sampled_from([None, 2.0]))
def test_targets_of_steps_keep_every_limit(steps, on_fault, lowpass):
    limits = {"position": [-1.0, 0.8], "speed": 2.0, "acceleration": 6.0}
    safety = make_filter(
        make_arm(), command="step", scale=0.5, limits={"all": limits}, home=[0.1, 0.2], on_fault=on_fault,
        lowpass_hz=lowpass, blend_in_s=0.2,
    )  # fmt: skip
    targets: list[np.ndarray] = []
    for action, positions, order in steps:
        if order == "reset" or (order == "resume" and safety.state == "stopped"):
            targets.clear()  # the next target begins at the measured positions
        give_order(safety, order)
        out = run_filter(safety, observe_at(*positions), action)
        if safety.command.target is None:
            assert (out == 0.0).all()
            continue
        before = targets[-1] if targets else safety.command.position
        targets.append(safety.command.target.copy())
        assert (targets[-1] <= np.maximum(0.8, before) + 1e-9).all()  # from outside only back
        assert (targets[-1] >= np.minimum(-1.0, before) - 1e-9).all()
        # The action leads from the measured position to the target; 1 of it is 0.5 rad, and it ranges from -10 to 10.
        step = np.clip(targets[-1] - safety.command.position, -5.0, 5.0)
        assert out == pytest.approx(step / 0.5, rel=1e-6, abs=1e-6)
    rows = np.array(targets).reshape(-1, 2)
    rounding, moved = 1e-9 * (1.0 + np.abs(rows)), np.diff(rows, axis=0)
    assert (np.abs(moved) <= 0.2 + rounding[1:]).all()  # 2 rad/s over 0.1 s
    assert (np.abs(np.diff(moved, axis=0)) <= 0.06 + rounding[2:]).all()  # 6 rad/s^2 over 0.1 s twice


def test_a_target_brakes_while_holding_and_does_not_jump_afterwards(arm):
    safety = make_filter(arm, command="step", scale=0.5, limits={"all": {"speed": 2.0, "acceleration": 6.0}})
    joint, targets = 0.0, [0.0]
    for step in range(40):
        is_missing = 10 <= step < 30
        safety.observe(None if is_missing else observe_at(joint, 0.0))
        safety.limit(None if is_missing else [1.0, 0.0])
        targets.append(float(safety.command.target[0]))
        joint += 0.5 * (targets[-1] - joint)  # the joint lags behind its target
    moved = np.diff(targets)
    assert moved[9] == pytest.approx(0.2)  # at full speed when the measurements end
    assert moved[10:14] == pytest.approx([0.14, 0.08, 0.02, 0.0])
    assert np.abs(np.diff(moved)).max() <= 0.06 + 1e-9


@settings(REPEATABLE, max_examples=40)
@given(steps=STEPS)
def test_speeds_keep_every_limit(steps):
    limits = {"position": [-1.0, 0.8], "speed": 2.0}
    safety = make_filter(make_arm(), command="speed", limits={"all": limits}, home=[0.1, 0.2])
    factor, known = 0.1, None
    for action, positions, order in steps:
        give_order(safety, order)
        if order == "reset":
            known = None
        x = run_filter(safety, observe_at(*positions), action).astype(np.float64) * factor
        known = positions.astype(np.float64) if np.isfinite(positions).all() else known
        assert (np.abs(x) <= 0.2 + 1e-6).all()
        if known is not None:
            tolerance = 1e-6
            assert ((known + x <= 0.8 + tolerance) | (x <= tolerance)).all()
            assert ((known + x >= -1.0 - tolerance) | (x >= -tolerance)).all()


@settings(REPEATABLE, max_examples=40)
@given(steps=STEPS, command=st.sampled_from(["torque", "action"]))
def test_values_keep_every_limit(steps, command):
    limits = {"rate": 5.0, "action": [-1.5, 2.0], **({"torque": 1.8} if command == "torque" else {})}
    safety = make_filter(make_arm(), command=command, limits={"all": limits}, blend_in_s=0.2)
    before = np.zeros(2)
    for action, positions, order in steps:
        if order != "home":
            give_order(safety, order)
        before = np.zeros(2) if order == "reset" else before
        out = run_filter(safety, observe_at(*positions), action).astype(np.float64)
        assert (out >= -1.5 - 1e-6).all()
        assert (out <= (1.8 if command == "torque" else 2.0) + 1e-6).all()
        assert (np.abs(out - before) <= 0.5 + 1e-6).all()  # 5 per second over 0.1 s
        before = out


def test_a_robot_that_was_moved_while_stopped_resumes_from_there():
    safety = make_filter(make_arm(), command="position", limits={"all": {"speed": 1.0}}, blend_in_s=0)
    run_filter(safety, observe_at(0.0, 0.0), [0.0, 0.0])
    safety.stop()
    run_filter(safety, observe_at(0.5, -0.5), [0.0, 0.0])
    safety.resume()
    # 1 rad/s over 0.1 s from the measured 0.5 and -0.5, not from the last command at 0
    assert run_filter(safety, observe_at(0.5, -0.5), [0.8, -0.8]).tolist() == pytest.approx([0.6, -0.6], abs=1e-6)


@pytest.mark.parametrize(
    ("settings", "measured", "expected"),
    [
        ({"command": "torque", "scale": 10.0, "limits": {"all": {"torque": 15.0}}}, REST, [1, -1]),  # 20 N m of 15
        ({"command": "torque", "scale": 10.0, "limits": {"all": {"torque": 6.0}}}, REST, [0, 0]),
        # 0.5 rad/s over 0.1 s: 0.05 rad, 2.5 actions of 0.02 rad
        ({"command": "step", "scale": 0.02, "limits": {"all": {"speed": 0.5}}}, REST, [2, -2]),
    ],
)
def test_whole_numbers_never_exceed_a_limit(arm, settings, measured, expected):
    space = space_to_json(spaces.Box(-100, 100, (2,), np.int64))
    safety = make_filter(arm.model_copy(update={"action_space": space}), blend_in_s=0, **settings)
    assert run_filter(safety, measured, [100.0, -100.0]).tolist() == expected


def test_limits_without_a_whole_action(arm):
    info = arm.model_copy(update={"action_space": space_to_json(spaces.Box(-9, 9, (2,), np.int64))})
    with pytest.raises(RecipeError, match="no action keeps these limits"):
        make_filter(info, command="position", scale=93.0, limits={"all": {"position": [0.5, 2.9]}})
    with pytest.raises(RecipeError, match="smallest whole action is faster than the limits allow"):
        make_filter(info, command="action", limits={"all": {"rate": 6.0}})  # 0.6 in a step of 0.1 s
    safety = make_filter(info, command="action", limits={"all": {"rate": 16.0}}, blend_in_s=0)
    assert [int(run_filter(safety, REST, [9.0, 9.0])[0]) for _ in range(4)] == [1, 2, 3, 4]  # 1.6 in a step


def test_whole_numbers_are_rounded_and_stay_within_their_limits(arm):
    space = space_to_json(spaces.Box(-5, 5, (2,), np.int64))
    info = arm.model_copy(update={"action_space": space})
    safety = make_filter(info, command="action", limits={"all": {"action": [-2.5, 2.5]}}, blend_in_s=0)
    assert run_filter(safety, REST, [0.9, -0.9]).tolist() == [1, -1]
    assert run_filter(safety, REST, [5.0, -5.0]).tolist() == [2, -2]
