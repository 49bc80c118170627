"""Finds out what each number of the action does: the same episode again, with this number at other values."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.context import Context
from rlctl.check_env.evidence import FIRST_SEED, SECOND_SEED
from rlctl.check_env.failures import EnvironmentRaised, describe
from rlctl.check_env.leaves import Leaf
from rlctl.check_env.legacy import result, skip
from rlctl.check_env.messages import Message
from rlctl.check_env.results import ActionEffect, ActionEffects, NanAction, OutOfRange
from rlctl.check_env.studies.action_trials import (
    Dimension,
    Edit,
    Frame,
    OutOfTime,
    Trials,
    compare,
    dimensions,
    replaced,
)

MOST_DIMENSIONS = 64
STAGES = ((FIRST_SEED, 3), (FIRST_SEED, 20), (SECOND_SEED, 60))
"""Seeds and steps that are tried until a difference shows: most show at once, some need time or another start."""
REPEATED_STEPS = 20
LONGEST_DELAY = 4
"""Observations may hold so many earlier actions; a penalty on changes of the action reaches as far [steps]."""
SATURATED = 0.2
"""The part of the range from which on nothing may change for it to be called saturated: four fifths are then lost."""
SWITCH = 0.01
"""If even from here on nothing changes, only the sign counts: a gripper's switch, say, which may be meant."""
TWICE = 2.0
STEPS_AFTER_NAN = 5


def action_effects(context: Context) -> Iterator[Message]:
    """Say what each number of the action does."""
    with context.fresh() as instance:
        trials = Trials(instance, context.budget)
        every = dimensions(instance.action_leaves)
        if reason := _hindered(trials, bool(every)):
            yield skip("action effects", reason)
            return
        found: list[ActionEffect] = []
        left_out = f"only {MOST_DIMENSIONS} are tried" if len(every) > MOST_DIMENSIONS else ""
        try:
            for dimension in every[:MOST_DIMENSIONS]:
                found.append(_effect(trials, dimension))
        except OutOfTime:
            left_out = "there was no time for more"
        if found:
            yield result(ActionEffects(found, len(every), left_out))
        else:
            yield skip("action effects", "there was no time to try a single action")


def _hindered(trials: Trials, can_vary: bool) -> str:
    if not can_vary:
        return "no action of a known kind that can be varied"
    if not trials.instance.accepts_seed:
        return "reset takes no seed (RL202)"
    try:
        if not trials.is_repeatable(FIRST_SEED, REPEATED_STEPS):
            return "equal seeds and actions give unequal episodes (RL3)"
    except OutOfTime:
        return "living one episode twice took all the time there is for it"
    return ""


def _effect(trials: Trials, dimension: Dimension) -> ActionEffect:
    copies = trials.copies(dimension, FIRST_SEED, REPEATED_STEPS, LONGEST_DELAY)
    kind = "none"
    for seed, steps in STAGES:
        plain = trials.plain(seed, steps)
        for end in dimension.ends:
            lived = trials.edited(seed, steps, Edit(dimension, end))
            difference = compare(plain, lived, copies)
            if difference.observations:
                saturates = _saturates(trials, dimension, copies) if dimension.is_continuous else ""
                return ActionEffect(dimension.name, "lasting", saturates, [seed], steps)
            if difference.rewards:
                kind = "cost"
            elif kind == "none" and compare(plain, lived).observations:
                kind = "copy"
    if kind == "cost" and _lasts(trials, dimension):
        kind = "lasting"
    return ActionEffect(dimension.name, kind, "", [FIRST_SEED, SECOND_SEED], STAGES[-1][1])


def _lasts(trials: Trials, dimension: Dimension) -> bool:
    """Say whether a single changed action changes rewards long after it: by a state that is not observed."""
    for seed, steps in STAGES[1:]:
        plain = trials.plain(seed, steps)
        at = (len(plain) - 1) // 4
        for end in dimension.ends:
            lived = trials.edited(seed, steps, Edit(dimension, end, at))
            # The action of index `at` gives frame `at + 1`.
            if any(step > at + 1 + LONGEST_DELAY for step in compare(plain, lived).rewards):
                return True
    return False


def _saturates(trials: Trials, dimension: Dimension, copies: NDArray[np.intp]) -> str:
    """Say whether small and large values do the same, in both directions."""
    low, high = dimension.bounds
    middle, half = (low + high) / 2, (high - low) / 2

    def same(first: float, second: float) -> bool:
        for seed, steps in STAGES:
            one, two = (trials.edited(seed, steps, Edit(dimension, middle + part * half)) for part in (first, second))
            if compare(one, two, copies).observations:
                return False
        return True

    if not (same(SATURATED, 1.0) and same(-SATURATED, -1.0)) or (same(0.0, 1.0) and same(0.0, -1.0)):
        return ""
    return "switch" if same(SWITCH, 1.0) and same(-SWITCH, -1.0) else "range"


def out_of_range(context: Context) -> Iterator[Message]:
    """Live an episode at the corners of the action space, and again with twice these actions."""
    with context.fresh() as instance:
        trials = Trials(instance, context.budget, "extreme")
        can_vary = any(each.is_continuous for each in dimensions(instance.action_leaves))
        if reason := _hindered(trials, can_vary):
            yield skip("out of range", reason)
            return
        inside = trials.plain(FIRST_SEED, REPEATED_STEPS)
        given = trials.actions(FIRST_SEED, REPEATED_STEPS)
        beyond = [replaced(each, instance.action_leaves, _twice) for each in given]
        outside, raised = _lived(trials.frames(FIRST_SEED, beyond))
        yield result(_compared(inside, outside, raised))


def _lived(lived: Iterator[Frame]) -> tuple[list[Frame], str | None]:
    """Return the frames of an episode, and what a step of it raised."""
    frames: list[Frame] = []
    try:
        for frame in lived:
            frames.append(frame)
    except OutOfTime:
        return frames, None
    except EnvironmentRaised as error:
        if error.call != "step":
            raise
        return frames, describe(error.__cause__ or error)
    return frames, None


def _twice(part: NDArray[Any], leaf: Leaf) -> NDArray[Any]:
    low, high = np.asarray(leaf.low, np.float64), np.asarray(leaf.high, np.float64)
    bounded = np.isfinite(low) & np.isfinite(high)
    middle = np.where(bounded, (low + high) / 2, 0.0)
    return np.where(bounded, middle + TWICE * (part - middle), part)


def _compared(inside: list[Frame], outside: list[Frame], raised: str | None) -> OutOfRange:
    lived = len(outside) - 1
    for step, (a, b) in enumerate(zip(inside, outside, strict=False)):
        difference = compare([a], [b])
        if a.ended != b.ended:
            return OutOfRange(raised, FIRST_SEED, lived, "end", step, float(any(a.ended)), float(any(b.ended)))
        if difference.observations:
            one, two = _largest_difference(a.observation, b.observation)
            return OutOfRange(raised, FIRST_SEED, lived, "observation", step, one, two)
        if difference.rewards and np.isfinite((a.reward, b.reward)).all():
            return OutOfRange(raised, FIRST_SEED, lived, "reward", step, a.reward, b.reward)
    return OutOfRange(raised, FIRST_SEED, lived, "", 0, 0.0, 0.0)


def _largest_difference(one: NDArray[Any], two: NDArray[Any]) -> tuple[float, float]:
    if one.shape != two.shape:
        return float(one.size), float(two.size)
    a, b = np.nan_to_num(one.astype(np.float64)), np.nan_to_num(two.astype(np.float64))
    place = int(np.abs(a - b).argmax())
    return float(a[place]), float(b[place])


def nan_action(context: Context) -> Iterator[Message]:
    """Take an action of NaN, and a few good ones after it."""
    with context.fresh() as instance:
        if not any(leaf.kind == "Box" and leaf.dtype.startswith("float") for leaf in instance.action_leaves):
            yield skip("nan action", "no continuous action")
            return
        trials = Trials(instance, context.budget)
        first, *good = trials.actions(FIRST_SEED, 1 + STEPS_AFTER_NAN)
        lived = trials.frames(FIRST_SEED, [replaced(first, instance.action_leaves, _nan), *good])
        next(lived)
        # A simulator may write a log of what it did not like to where it is: MuJoCo does.
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            frames, raised = _lived(lived)
        if not frames and raised is None:
            yield skip("nan action", "there was no time for it")
            return
        finite = all(np.isfinite(each.reward) and _is_finite(each.observation) for each in frames)
        yield result(NanAction(raised, finite, FIRST_SEED, 1))


def _nan(part: NDArray[Any], leaf: Leaf) -> NDArray[Any]:
    return np.full_like(part, np.nan)


def _is_finite(values: NDArray[Any]) -> bool:
    return bool(np.isfinite(values).all())
