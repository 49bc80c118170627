"""For any input the output is finite and within every limit, or the filter has stopped.

Options, observations, actions, ages, orders and clocks are drawn from all that can be written, over the whole range of
float64. The limits are checked here from their definition alone.
"""

import itertools
import math
import warnings

import hypothesis.extra.numpy as arrays
import hypothesis.strategies as st
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings

from rlctl.deploy import Limits, SafetyFilter
from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.errors import RecipeError, UsageError
from tests.limits.conftest import JOINTS, REPEATABLE, make_filter, observe_at, run_filter

NO_COMMAND = "no command within the limits was found"
VALUES, MOTIONS = ("position", "torque", "action"), ("step", "speed")
EXTREME = st.sampled_from([0.0, -0.0, 5e-324, 1e-300, 1e30, -1e39, 1.7e308, -1.7e308, np.inf, -np.inf, np.nan])
NUMBERS = st.one_of(st.floats(-3, 3), st.floats(-3, 3), EXTREME, st.floats(width=64))
VECTORS = st.one_of(
    arrays.arrays(np.float64, 2, elements=st.floats(-3, 3)), arrays.arrays(np.float64, 2, elements=NUMBERS)
)
ACTIONS = st.one_of(
    VECTORS, VECTORS, st.none(), arrays.arrays(np.float64, st.integers(0, 4)), st.sampled_from(["no", [10**400, 0], {}])
)
ORDERS = st.sampled_from(["", "", "", "", "stop", "resume", "home", "hold", "reset", "override", "policy"])
AGES = st.one_of(st.just(0.0), st.just(0.0), NUMBERS)
STEP = st.tuples(ORDERS, VECTORS, ACTIONS, VECTORS, AGES, st.one_of(st.floats(0, 1), NUMBERS))
STEPS = st.lists(STEP, min_size=1, max_size=20)
SIZES = st.one_of(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3), st.floats(min_value=5e-324))
PAIRS = st.one_of(
    st.tuples(st.floats(-3, -0.01), st.floats(0.01, 3)),
    st.tuples(NUMBERS, NUMBERS).filter(lambda ends: ends[0] < ends[1]),
)


@st.composite
def choose_limits(draw):
    """What a limits file may say, for two joints."""
    command = draw(st.sampled_from([*VALUES, *MOTIONS]))
    keys = {"torque": ["torque", "rate"], "action": ["rate"]}.get(command, ["position", "speed", "acceleration"])
    kinds = {key: PAIRS if key in ("position", "action") else SIZES for key in [*keys, "action"]}
    joint = st.fixed_dictionaries({}, optional=kinds)
    sensor = st.fixed_dictionaries({}, optional={"range": PAIRS, "frozen_s": SIZES})
    numbers = st.lists(st.one_of(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), NUMBERS), min_size=2, max_size=2)
    options = {
        "limits": st.fixed_dictionaries({}, optional={"all": joint, "shoulder": joint}),
        "lowpass_hz": SIZES,
        "blend_in_s": st.one_of(st.floats(0, 1), SIZES),
        "sensors": st.fixed_dictionaries({}, optional={"goal": sensor}),
        "on_fault": st.sampled_from(["hold", "stop"]),
        "max_age_periods": SIZES,
    }
    if command not in MOTIONS:
        options["offset"] = st.one_of(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), NUMBERS)
    chosen = {"command": command, "scale": draw(SIZES), **draw(st.fixed_dictionaries({}, optional=options))}
    if draw(st.booleans()):
        chosen["safe_action" if command in ("torque", "action") else "home"] = draw(numbers)
        if "home" in chosen:
            chosen["on_fault"] = "home"
    return chosen


ENDS = st.one_of(st.sampled_from([(-1.0, 1.0), (-10.0, 10.0), (-np.inf, np.inf), (-1e-3, np.inf)]), PAIRS)
SPACES = st.tuples(st.sampled_from([np.float32, np.float64, np.float16, np.int8, np.int32]), ENDS)
DTS = st.one_of(st.sampled_from([0.001, 0.02, 0.1, 1.0]), SIZES)


def make_space(dtype, low, high):
    if np.dtype(dtype).kind == "i":
        return spaces.Box(np.iinfo(dtype).min, np.iinfo(dtype).max, (2,), dtype)
    with np.errstate(over="ignore"):
        return spaces.Box(np.full(2, low).astype(dtype), np.full(2, high).astype(dtype), dtype=dtype)


class Oracle:
    """Knows the limits from the file alone, and says which of them a sequence of actions breaks."""

    def __init__(self, limits, space, dt):
        self.space, self.dt, self.limits = space, dt, limits
        self.is_value = limits.command in VALUES
        unit = 1.0 if limits.scale is None else np.broadcast_to(limits.scale, 2)
        self.factor = unit * np.ones(2) * (dt if limits.command == "speed" else 1.0)
        self.offset = np.broadcast_to(0.0 if limits.offset is None else limits.offset, 2)
        moves = np.isfinite([self.read("speed", np.inf) * dt, self.read("acceleration", np.inf) * dt**2]).any()
        self.tracks = limits.command == "step" and space.dtype.kind == "f" and bool(moves)
        self.eps = np.finfo(space.dtype).eps if space.dtype.kind == "f" else np.finfo(np.float64).eps
        self.quantum = 1.0 if space.dtype.kind == "i" else self.eps
        self.forget()

    def read(self, key, missing):
        given = self.limits.limits
        values = [getattr(given.get(name), key, None) or getattr(given.get("all"), key, None) for name in JOINTS]
        return np.array([missing if value is None else value for value in values], np.float64)

    def forget(self):
        self.before = self.motion = None
        if self.limits.command in ("torque", "action"):
            safe = np.zeros(2) if self.limits.safe_action is None else np.array(self.limits.safe_action)
            low, high = self.find_range()
            self.before, self.motion = np.clip(self.offset + safe * self.factor, low, high), np.zeros(2)

    def find_range(self):
        ends = self.read("action", (-np.inf, np.inf)).T
        low = self.offset + self.factor * np.maximum(self.space.low, ends[0])
        high = self.offset + self.factor * np.minimum(self.space.high, ends[1])
        if self.is_value:
            position, torque = self.read("position", (-np.inf, np.inf)).T, self.read("torque", np.inf)
            low, high = (
                np.maximum(low, np.maximum(position[0], -torque)),
                np.minimum(high, np.minimum(position[1], torque)),
            )
        return low, high

    def find_broken_target(self, action, target, position):
        """Return what the target of a step breaks, or where the action is not the step to it."""
        before = position if self.before is None else self.before
        if target is None or position is None:
            return "" if (action == np.clip(0.0, self.space.low, self.space.high)).all() else "no target"
        low, high = self.find_range()
        largest = self.factor * min(float(np.finfo(self.space.dtype).max), 1e30)  # actions without bounds end there
        step = np.clip(target - position, np.maximum(low, -largest), np.minimum(high, largest))
        slack = 20 * self.eps * np.abs(step) + 2 * self.eps * self.factor + 1e-300
        if not (np.abs(action.astype(np.float64) * self.factor - step) <= slack).all():
            return "action"
        slack = 20 * np.finfo(np.float64).eps * (np.abs(target) + np.abs(before) + 1.0)
        low, high = self.read("position", (-1e30, 1e30)).T
        if not ((np.minimum(low, before) - slack <= target) & (target <= np.maximum(high, before) + slack)).all():
            return "position"
        x, self.before = target - before, target.copy()
        if not (np.abs(x) <= self.read("speed", np.inf) * self.dt + slack).all():
            return "speed"
        motion, self.motion = self.motion if self.motion is not None else np.zeros(2), x
        allowed = self.read("acceleration", np.inf) * self.dt**2 + 4 * slack
        return "" if (np.abs(x - motion) <= allowed).all() else "acceleration"

    def find_broken(self, action, position):
        """Return what the action breaks; `position` is None where it was not measured."""
        if not np.isfinite(action).all():
            return "finite"
        command = self.offset + action.astype(np.float64) * self.factor
        before, self.before = self.before, command
        if before is None and self.is_value:
            low, high = self.find_range()
            before = None if position is None else np.clip(position, low, high)
        slack = 20 * self.eps * (np.abs(command) + np.abs(self.offset)) + 2 * self.quantum * self.factor
        low, high = self.find_range()
        if not ((low - slack <= command) & (command <= high + slack)).all():
            return "range"
        if self.is_value and before is None:
            self.before = None
            return ""
        slack = slack + 20 * self.eps * np.abs(before if self.is_value else 0.0)
        x = command - before if self.is_value else command
        speed = (
            self.read("speed", np.inf)
            if self.limits.command in ("position", "step", "speed")
            else self.read("rate", np.inf)
        )
        if not (np.abs(x) <= speed * self.dt + slack).all():
            return "speed"
        motion, self.motion = self.motion if self.motion is not None else np.zeros(2), x
        change = np.abs(x - motion)
        where = position if not self.is_value else None
        braking = (np.abs(x) <= np.abs(motion) + slack) & (where is not None)
        if not ((change <= self.read("acceleration", np.inf) * self.dt**2 + 2 * slack) | braking).all():
            return "acceleration"
        if where is not None:
            slack = slack + 20 * self.eps * np.abs(where)
            low, high = self.read("position", (-np.inf, np.inf)).T
            if not (((where + x <= high + slack) | (x <= slack)) & ((where + x >= low - slack) | (x >= -slack))).all():
                return "position"
        return ""


def attack(options, space, dt, steps):
    """Play steps through a filter and return it; check each of its actions."""
    box = make_space(space[0], *space[1])
    if not (box.low <= box.high).all():
        return None
    info = EnvInfo(
        observation_space=space_to_json(spaces.Box(-np.inf, np.inf, (5,), np.float64)),
        action_space=space_to_json(box), observation_sizes={"positions": 2, "goal": 3}, control_dt=dt,
    )  # fmt: skip
    clock = itertools.chain((step[5] for step in steps), itertools.repeat(0.0))
    try:
        limits = Limits.model_validate({"joints": JOINTS, "measured": {"position": "positions"}, **options})
        safety = SafetyFilter(info, limits, clock=lambda: next(clock))
    except (RecipeError, UsageError, ValueError):
        return None
    with np.errstate(all="ignore"):
        oracle, position = Oracle(limits, box, dt), None
    for order, hand, action, where, age, _ in steps:
        was_stopped = safety.state == "stopped"
        try:
            if order in ("override", "policy"):
                safety.override(hand if order == "override" else None)
            elif order:
                getattr(safety, order)()
        except (ValueError, UsageError):
            assert order in ("override", "home")
        if order == "reset" or (oracle.tracks and order == "resume" and was_stopped):
            with np.errstate(all="ignore"):
                oracle.forget()
            position = None if order == "reset" else position
        observation = np.array([*where, 0.0, where[0], 0.0])
        position = where if safety.observe(observation, age) else position
        with warnings.catch_warnings(action="error"):
            output = safety.limit(action)
        assert output.dtype == box.dtype
        assert output.shape == box.shape
        assert np.isfinite(output).all()
        assert (box.low <= output).all()
        assert (output <= box.high).all()
        with np.errstate(all="ignore"):
            if oracle.tracks:
                broken = oracle.find_broken_target(output, safety.command.target, position)
            else:
                broken = oracle.find_broken(output, position)
        assert broken == "" or safety.state == "stopped"
        assert safety.reason != NO_COMMAND or safety.state == "stopped"
        for event in safety.events:
            assert event.name
    return safety


@pytest.mark.slow
@settings(REPEATABLE, max_examples=60)
@given(choose_limits(), SPACES, DTS, STEPS)
def test_the_output_keeps_every_limit(options, space, dt, steps):
    attack(options, space, dt, steps)


@pytest.mark.slow
@settings(REPEATABLE, max_examples=20_000)
@given(choose_limits(), SPACES, DTS, STEPS)
def test_the_output_keeps_every_limit_for_long(options, space, dt, steps):
    attack(options, space, dt, steps)


def test_huge_orders_by_hand_do_not_disturb_what_follows(arm):
    safety = make_filter(arm, limits={"all": {"action": [-0.5, 0.5]}}, lowpass_hz=8)
    rest = observe_at(0, 0)
    for hand, expected in ((1.7e308, 0.5), (-1.7e308, -0.5)):
        safety.override([hand, hand])
        assert [run_filter(safety, rest, [0.1, 0.1])[0] for _ in range(5)][-1] == pytest.approx(expected)
    safety.override(None)
    assert [run_filter(safety, rest, [0.1, 0.1])[0] for _ in range(5)][-1] == pytest.approx(0.1)


def test_one_huge_action_moves_as_far_as_the_speed_allows(arm):
    safety = make_filter(arm, command="position", scale=2.0, blend_in_s=0.5, limits={"all": {"speed": 1.0}})
    # 1 rad/s over 0.1 s are 0.1 rad, 0.05 of the action.
    assert [run_filter(safety, observe_at(0, 0), [1e308, 0.0])[0] for _ in range(2)] == pytest.approx([0.05, 0.1])


@pytest.mark.parametrize("state", ["_smooth", "_reference", "_before"])
def test_a_result_that_is_not_finite_stops_the_robot(arm, state):
    limits = {"all": {"speed": 1.0, "acceleration": 100.0}}
    safety = make_filter(arm, command="position", limits=limits, lowpass_hz=3)
    rest = observe_at(0, 0)
    last = run_filter(safety, rest, [0.05, 0.05])
    setattr(safety.command, state, np.full(2, math.nan))  # a mistake in our arithmetic, as there was one
    for _ in range(3):
        output = run_filter(safety, rest, [0.05, 0.05])
        assert np.isfinite(output).all()
        assert safety.state == "stopped"
    assert output == pytest.approx(last)
    assert safety.reason == NO_COMMAND
