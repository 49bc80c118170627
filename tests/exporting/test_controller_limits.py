"""The limits in C are those in Python: the same actions and states, bit for bit, for any inputs and orders."""

import collections
import shutil
import subprocess

import numpy as np
import pytest

from rlctl.deploy import Limits, SafetyFilter
from rlctl.exporting.c_source import find_compiler
from rlctl.exporting.controller.controllers import STATUS
from rlctl.exporting.controller.source import ControllerSource
from rlctl.task import terms
from tests.exporting.controllers import build_controller, make_arm, make_policy, plan_of

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler (cc, or $CC) on this machine")
JOINTS = ["shoulder", "elbow"]
MEASURED = {"position": "positions"}
SENSORS = {"goal": {"range": [-1e30, 1e30], "frozen_s": 0.3}, "positions": {"range": [-50.0, 50.0]}}
MOVING = {"position": [-1.5, 2.0], "speed": 1.0, "acceleration": 4.0}
ARM = {"low": -10.0, "high": 10.0}
NARROW = {"low": -1.0, "high": 1.0}
CASES = {
    "position": (
        NARROW,
        {
            "command": "position",
            "scale": [0.8, 1.3],
            "offset": [0.1, -0.2],
            "measured": MEASURED,
            "limits": {"all": MOVING, "elbow": {"acceleration": 1e-3}},
            "lowpass_hz": 2.0,
            "blend_in_s": 1.0,
            "sensors": SENSORS,
            "on_fault": "home",
            "home": [0.5, -0.5],
        },
    ),
    "step": (
        NARROW,
        {
            "command": "step",
            "scale": 0.2,
            "measured": MEASURED,
            "limits": {"all": MOVING},
            "lowpass_hz": 3.0,
            "sensors": SENSORS,
            "max_age_periods": 2.0,
            "home": [0.5, -0.5],
        },
    ),
    "action": (ARM, {"safe_action": [0.5, 0.0], "limits": {"elbow": {"rate": 5.0}, "shoulder": {"action": [-1, 3]}}}),
}
MORE_CASES = {
    "bare": (ARM, {}),
    "unbounded": ({"low": -np.inf, "high": np.inf}, {"blend_in_s": 0.5}),
    "double": ({**ARM, "dtype": np.float64}, {"command": "position", "measured": MEASURED, "limits": {"all": MOVING}}),
    "unmeasured": (ARM, {"command": "position", "limits": {"all": {"position": [-1, 1]}}, "on_fault": "stop"}),
    "position_only": (ARM, {"command": "position", "measured": MEASURED, "limits": {"elbow": {"position": [0, 2]}}}),
    "speed": (
        NARROW,
        {
            "command": "speed",
            "scale": 2.0,
            "measured": MEASURED,
            "limits": {"all": {"position": [-1.0, 1.0]}, "elbow": {"acceleration": 3.0}},
            "blend_in_s": 0.4,
            "home": [0.0, 0.9],
            "on_fault": "home",
        },
    ),
    "step_only": (NARROW, {"command": "step", "scale": 0.3, "on_fault": "stop", "limits": {"all": {"speed": 0.5}}}),
    "step_to_bounds": (
        NARROW,
        {"command": "step", "scale": 0.3, "measured": MEASURED, "limits": {"all": {"position": [-1.0, 1.0]}}},
    ),
    "torque": (
        NARROW,
        {"command": "torque", "scale": 30.0, "limits": {"all": {"torque": 20.0, "rate": 100.0}}, "lowpass_hz": 1.0},
    ),
    "huge": (
        {"low": -np.inf, "high": np.inf, "dtype": np.float64},
        {"command": "action", "limits": {"all": {"rate": 1e300}}, "lowpass_hz": 4.0},
    ),
}


def draw_steps(rng, count, dtype):
    """Random quantities, actions, ages and orders: moderate ones, and those of any bits."""
    moderate = rng.uniform(-3, 3, (count, 7))
    with np.errstate(all="ignore"):
        anything = rng.integers(0, 2**32, (count, 7), np.uint32).view(np.float32).astype(np.float64)
        if dtype == np.float64:
            anything[:, 5:] = rng.integers(0, 2**64, (count, 2), np.uint64).view(np.float64)
    odd = np.array([0.0, -0.0, 1.5, -1.5, 2.0, 10.0, -10.0, np.inf, np.nan, 1e-40, 3.4e38, 1.0, -1.0])
    kind = rng.random((count, 7))
    rows = np.where(kind < 0.97, moderate, np.where(kind < 0.985, anything, rng.choice(odd, (count, 7))))
    ages = np.where(
        rng.random(count) < 0.97, 0.0, rng.choice([0.1, 0.19, 0.31, -0.2, 5.0, -5.0, np.inf, np.nan], count)
    )
    orders = rng.choice(["", "stop", "hold", "home", "resume", "reset", "missing", "none", "frozen"], count, p=ORDERS)
    return rows, ages, orders


STEPS = 1_000_000  # of all cases together
ORDERS = [0.88, 0.005, 0.005, 0.01, 0.03, 0.02, 0.01, 0.01, 0.03]


def compare(arm, options, count, seed, folder):
    """Run both filters, which must give the same bits; return how often each state and reason came."""
    limits = Limits.model_validate({"joints": JOINTS, **options})
    source, controller = build_controller(make_policy(make_arm(**arm)), folder, limits)
    safety = SafetyFilter(source.plan.inputs_info, limits, clock=lambda: 0.0)
    space = source.plan.action_space
    rng, seen, position = np.random.default_rng(seed), collections.Counter[str](), None
    last, is_frozen = np.zeros(5), False
    for row, age, order in zip(*draw_steps(rng, count, space.dtype), strict=True):
        if order in ("stop", "hold", "resume", "reset") or (order == "home" and "home" in options):
            getattr(safety, order)()
            controller.order(order)
        with np.errstate(all="ignore"):
            values = row[:5].astype(np.float32).astype(np.float64)
            if position is not None and rng.random() < 0.9:  # the joints are about where they were sent
                values[:2] = (position + 0.01 * row[:2]).astype(np.float32)
            is_frozen = order == "frozen" or (is_frozen and rng.random() < 0.7)
            values = np.array(last) if is_frozen else values
            requested = row[5:].astype(space.dtype)
        last = values
        observed = None if order == "missing" else values
        action = None if order == "none" else requested
        safety.observe(observed, float(age))
        expected = safety.limit(action)
        got = controller.limit(observed, float(age), action)
        assert np.isfinite(expected).all()
        assert (got == expected).all(), (got, expected, safety.state)
        assert controller.status[0] == safety.state
        assert is_same_reason(controller.status[1], safety.reason), (controller.status, safety.reason)
        seen.update(controller.status)
        position = find_position(safety, expected)
    return seen


def find_position(safety, action):
    """Where joints are that follow the commands."""
    command = safety.command
    if command._reference is None:
        return None
    moved = command._reference + (0.0 if command._bounds.is_value else command._before)
    return moved if np.isfinite(moved).all() and (np.abs(moved) < 1e3).all() else None


def is_same_reason(reason, text):
    if reason == "unsafe":
        return "no command" in text or "outside its limits" in text
    return reason in text if reason else text == ""


# Takes seconds, and runs in every `make test`: limits in C.
@pytest.mark.slow_except("action")
@pytest.mark.parametrize("case", CASES)
def test_limits_in_c_are_those_in_python(case, tmp_path):
    seen = compare(*CASES[case], 6_700, 1, tmp_path)
    assert min(seen[state] for state in ("running", "holding", "stopped")) > 100
    faults = {"missing", "not finite", "too old", "invalid action", "no action"}
    faults |= {"out of range", "frozen"} if "sensors" in CASES[case][1] else set()
    assert min(seen[reason] for reason in faults) >= 5


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler")
@pytest.mark.parametrize("case", ["position", "step"])
def test_the_file_compiles_as_c_plus_plus(case, tmp_path):
    arm, options = CASES[case]
    limits = Limits.model_validate({"joints": JOINTS, **options})
    policy = make_policy(make_arm(**arm))
    code = ControllerSource(policy, plan_of(policy), "arm", limits).write()
    (tmp_path / "arm.h").write_text(code.header)
    (tmp_path / "arm.c").write_text(code.source)
    strict = ["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only"]
    subprocess.run(["c++", "-x", "c++", *strict, "arm.c"], cwd=tmp_path, check=True)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("case", [*CASES, *MORE_CASES])
def test_a_million_steps(case, tmp_path):
    arm, options = (CASES | MORE_CASES)[case]
    seen = compare(arm, options, STEPS // len(CASES | MORE_CASES) + 1, 2, tmp_path)
    assert sum(seen[state] for state in STATUS) == STEPS // len(CASES | MORE_CASES) + 1


@pytest.mark.slow
def test_the_header_says_which_limit_only_a_server_uses():
    policy = make_policy(make_arm())
    limits = Limits.model_validate({"command": "action", "watchdog_periods": 30})
    header = ControllerSource(policy, plan_of(policy), "arm", limits).write().header
    assert " *   watchdog_periods: 30; only `rlctl serve` uses it\n" in header


def test_default_ranges_of_orientations_and_commands(tmp_path):
    env = make_arm(
        observation_terms={"goal": terms.Gravity("orientation")},
        quantity_sizes={"orientation": 4},
        command_ranges={"lin_vel_x": (-0.5, 1.0), "ang_vel_z": (-0.7, 0.7)},
    )
    env = env.model_copy(update={"observation_sizes": {"command": 2, "goal": 3}})
    source, controller = build_controller(make_policy(env), tmp_path)
    header = source.write().header
    assert " * Inputs older than 0.3 s (max_age_periods: 3) are a fault.\n" in header
    assert " *   command: -0.5 to 1, -0.7 to 0.7\n *   orientation: norm 0.9 to 1.1\n" in header
    safety = SafetyFilter(source.plan.inputs_info)
    for orientation, command, is_sound in [
        ([0, 0, 0, 1], [1.0, -0.7], True),  # -0.7 is lower in float32
        ([0, 0, 0, 0], [0, 0], False),  # a sensor that has not started
        ([0, 0, 0.7, 0.7], [0, 0], True),  # norm 0.99
        ([0, 0, 0, 1.11], [0, 0], False),
        ([50, 50, 50, 50], [0, 0], False),
        ([0, 0, 0, -1], [1e6, 0], False),
        ([0, 0, 0, -1], [0, 0.71], False),
    ]:
        inputs = {"command": np.array(command), "orientation": np.array(orientation)}
        controller.step(inputs)
        assert controller.status == (("running", "") if is_sound else ("holding", "out of range"))
        assert safety.observe(np.concatenate([*inputs.values()]).astype(np.float32)) == is_sound
    assert safety.events[0].name == "orientation out of range"
    assert (safety.events[0].value, safety.events[0].limit) == (0.0, 0.9)
