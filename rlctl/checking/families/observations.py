"""RL101 to RL109: spaces that learners can use, and observations inside their space."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.leaves import Leaf, name_leaf
from rlctl.checking.records import CheckedEpisode, Form, Records, Series
from rlctl.checking.rules import RECORDING, RuleFinding, Severity, check, list_names

ROUNDING = 1e-6  # Excess over a bound, relative to the bound, up to which it is float rounding
LARGE_SHARE, SMALL_SHARE = 0.1, 0.005  # of all observations but the last ones, for an error, or a warning
OFF_CENTRE = 0.05  # part of the range that zero may be off its middle, for an info
MOST_NAMED = 8
SMALLEST_SIDE = 36  # smaller images do not fit the default network's filters [pixels]


def _forms(records: Records) -> Iterator[tuple[Leaf, list[tuple[CheckedEpisode, Form]]]]:
    forms = records.forms("observation")
    for index, leaf in enumerate(records.require_built().leaves):
        if leaf.supported:
            yield leaf, [pair for pair in forms if pair[1].leaf == index]


def _when(step: int) -> str:
    return "from reset" if step == 0 else f"at step {step}"


@check("RL101")
def _find_wrong_shape(records: Records) -> Iterator[RuleFinding]:
    for leaf, forms in _forms(records):
        for trajectory, form in forms:
            if what := _wrong_shape(leaf, form):
                shape = None if form.shape is None else list(form.shape)
                message = f"{name_leaf(leaf)} {_when(form.step)} {what}"
                evidence = trajectory.at(form.step, type=form.type, shape=shape, expected=list(leaf.shape))
                yield RuleFinding("RL101", message, evidence)
                break
    for trajectory, form in records.forms("keys")[:1]:
        message = f"observation has the keys {form.type}; the space has other ones"
        yield RuleFinding("RL101", message, trajectory.at(form.step))


def _wrong_shape(leaf: Leaf, form: Form) -> str:
    if form.type == "missing":
        return f"is missing; the space has shape {leaf.shape}"
    if form.shape != leaf.shape:
        what = f"has shape {form.shape}" if form.shape is not None else f"is not an array but a {form.type}"
        return f"{what}; the space has shape {leaf.shape}"
    return f"is a {form.type}, not a numpy array" if form.type in ("list", "tuple") else ""


@check("RL102")
def _find_wrong_dtype(records: Records) -> Iterator[RuleFinding]:
    wrong = [
        (leaf, trajectory, form)
        for leaf, forms in _forms(records)
        for trajectory, form in forms
        if _has_wrong_dtype(leaf, form)
    ]
    parts = len({leaf.path for leaf, *_ in wrong})
    for leaf, trajectory, form in wrong[:1]:
        more = f"; {parts - 1} other parts differ too" if parts > 1 else ""
        message = f"{name_leaf(leaf)} {_when(form.step)} is {form.dtype}; the space is {leaf.dtype}{more}"
        is_number = np.dtype(form.dtype).kind in "biuf"
        evidence = trajectory.at(form.step, dtype=form.dtype, expected=leaf.dtype)
        yield RuleFinding("RL102", message, evidence, Severity.WARNING if is_number else Severity.ERROR)


def _has_wrong_dtype(leaf: Leaf, form: Form) -> bool:
    if form.dtype is None or form.shape != leaf.shape or form.type in ("list", "tuple"):
        return False
    dtype, declared = np.dtype(form.dtype), np.dtype(leaf.dtype)
    if leaf.kind != "Box":
        return dtype.kind not in "iub"
    return dtype != declared and not (form.type in ("float", "int") and leaf.shape == ())


@check("RL103")
def _find_out_of_range(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    for index, leaf in enumerate(built.leaves):
        recorded = [(*pair, _excess(leaf, pair[1].values)) for pair in records.series(index) if leaf.supported]
        if not any(excess.any() for *_, excess in recorded):
            continue
        trajectory, series, excess = max(recorded, key=lambda record: float(record[2].max(initial=0.0)))
        row, flat = divmod(int(excess.argmax()), excess.shape[1])
        step, value = int(series.steps[row]), float(series.values[row].flat[flat])
        low, high = (float(np.ravel(np.asarray(bound))[flat]) for bound in (leaf.low, leaf.high))
        bound = low if value < low else high
        is_rounding = np.dtype(leaf.dtype).kind == "f" and abs(value - bound) <= ROUNDING * max(abs(bound), 1e-3)
        outside = np.concatenate([excess.any(axis=1) for *_, excess in recorded])
        count, total = int(outside.sum()), len(outside)
        element = built.element(index, flat)
        columns = np.flatnonzero(np.any([record[2].any(axis=0) for record in recorded], axis=0))
        others = [built.element(index, int(column)) for column in columns if column != flat]
        more = f"; so are {list_names(others, MOST_NAMED)}" if others else ""
        yield RuleFinding(
            "RL103",
            f"{element} is {value:.9g} {_when(step)}; the space allows [{low:.9g}, {high:.9g}]"
            f"{' (float rounding)' if is_rounding else ''}; {count} of {total} observations are outside{more}",
            trajectory.at(
                step, element=element, value=value, expected=[low, high], observations_outside=count, observations=total
            ),
            Severity.WARNING if is_rounding else _severity_of_outside(recorded, outside),
        )


def _severity_of_outside(
    recorded: list[tuple[CheckedEpisode, Series, NDArray[np.float64]]], outside: NDArray[np.bool_]
) -> Severity:
    """Return how bad it is that some observations are outside. Shape of `outside`: all that were recorded."""
    is_first = np.concatenate([series.steps == 0 for _, series, _ in recorded])
    is_last = np.concatenate([(series.steps == episode.steps) & episode.has_ended for episode, series, _ in recorded])
    share = float((outside & ~is_last).mean())
    if share >= LARGE_SHARE or (outside & is_first).any():
        return Severity.ERROR
    return Severity.WARNING if share >= SMALL_SHARE else Severity.INFO


def _excess(leaf: Leaf, values: NDArray[Any]) -> NDArray[np.float64]:
    """How far values are outside their bounds; 0 inside, and for NaN, which is another rule's. Shape: (n, elements)."""
    low, high = np.asarray(leaf.low, np.float64), np.asarray(leaf.high, np.float64)
    wide = values.astype(np.float64)
    with np.errstate(invalid="ignore"):
        excess = np.maximum(np.maximum(low - wide, wide - high), 0.0)
    return np.where(np.isfinite(wide), excess, 0.0).reshape(len(values), -1)


@check("RL104")
def find_not_finite(records: Records) -> Iterator[RuleFinding]:
    """Find the first NaN or infinity, per leaf."""
    built = records.require_built()
    for index, _ in enumerate(built.leaves):
        for trajectory, series in records.series(index):
            if series.values.dtype.kind != "f" or np.isfinite(series.values).all():
                continue
            values = series.values.reshape(len(series.values), -1)
            row, flat = np.argwhere(~np.isfinite(values))[0].tolist()
            step, element, value = int(series.steps[row]), built.element(index, flat), str(values[row, flat])
            evidence = trajectory.at(step, element=element, value=value, expected="finite")
            yield RuleFinding("RL104", f"{element} is {value} {_when(step)}", evidence)
            break


@check("RL105")
def _find_shared_memory(records: Records) -> Iterator[RuleFinding]:
    for trajectory, form in records.forms("memory")[:1]:
        name = name_leaf(records.require_built().leaves[form.leaf or 0])
        message = f"step {form.step} wrote into the memory of the {name} returned before it"
        yield RuleFinding("RL105", message, trajectory.at(form.step, steps=form.count))


@check("RL106", "build")
def _find_unusual_actions(records: Records) -> Iterator[RuleFinding]:
    for leaf in records.require_built().action_leaves:
        if leaf.kind == "Box":
            yield from _unusual_actions(leaf)


def _unusual_actions(leaf: Leaf) -> Iterator[RuleFinding]:
    low, high = np.ravel(np.asarray(leaf.low, np.float64)), np.ravel(np.asarray(leaf.high, np.float64))
    is_open = ~np.isfinite(low) | ~np.isfinite(high)
    is_thrust = (low == 0) & (high <= 1)  # or a pedal: by nature to one side
    with np.errstate(invalid="ignore"):
        off = np.where(is_open | is_thrust, 0.0, np.abs(low + high) / np.maximum(high - low, 1e-9))
    for wrong, severity, what in (
        (is_open, Severity.ERROR, "have no finite bounds"),
        (off > OFF_CENTRE, Severity.WARNING, "are not symmetric"),
        (off > 0, Severity.INFO, "are not quite symmetric"),
        ((low != -1) | (high != 1), Severity.INFO, "are not in [-1, 1]"),
    ):
        if wrong.any():
            i = int(wrong.argmax())
            name = f"action[{i}]"
            message = f"{int(wrong.sum())} of {wrong.size} actions {what}: {name} is in [{low[i]:g}, {high[i]:g}]"
            evidence = {"element": name, "value": [float(low[i]), float(high[i])], "expected": [-1.0, 1.0]}
            yield RuleFinding("RL106", message, evidence, severity)
            return
    if leaf.dtype != "float32":
        evidence = {"value": leaf.dtype, "expected": "float32"}
        yield RuleFinding("RL106", f"actions are {leaf.dtype}", evidence, Severity.INFO)


@check("RL108", "build", *RECORDING)
def _find_unusual_images(records: Records) -> Iterator[RuleFinding]:
    for index, leaf in enumerate(records.require_built().leaves):
        name, shape = name_leaf(leaf), list(leaf.shape)
        if leaf.kind == "Box" and (problem := _image_problem(leaf)):
            yield RuleFinding("RL108", f"{name} {problem}", {"element": name, "value": shape, "dtype": leaf.dtype})
        elif leaf.kind == "Box" and _is_in_image_format(leaf) and (brightest := _brightest(records, index)) in (0, 1):
            message = f"{name} is uint8 up to 255, and its brightest pixel was {brightest}: scaled twice?"
            yield RuleFinding("RL108", message, {"element": name, "value": brightest, "expected": 255})


def _is_in_image_format(leaf: Leaf) -> bool:
    in_range = np.all(leaf.low == 0) and np.all(leaf.high == 255)
    return len(leaf.shape) == 3 and leaf.dtype == "uint8" and bool(in_range)


def _image_problem(leaf: Leaf) -> str:
    """Say what is wrong with what is as large as a picture, or has the format of one; nothing for anything else."""
    is_large = sum(size >= SMALLEST_SIDE for size in leaf.shape) >= 2
    is_table = len(leaf.shape) == 2 and leaf.dtype != "uint8"
    if is_large and not is_table and not _is_in_image_format(leaf):
        return f"is as large as an image, {leaf.shape}, and not (height, width, channels) of uint8 in [0, 255]"
    if _is_in_image_format(leaf) and not is_large:
        return f"has the shape of an image, {leaf.shape}, smaller than {SMALLEST_SIDE} x {SMALLEST_SIDE}"
    return ""


def _brightest(records: Records, index: int) -> int | None:
    return max((int(series.values.max()) for _, series in records.series(index) if series.values.size), default=None)


@check("RL109", "build")
def _find_unsupported_spaces(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    for what, leaves, depth in (("observation", built.leaves, 1), ("action", built.action_leaves, 0)):
        for leaf in leaves:
            if kind := _unsupported_kind(leaf, depth):
                name, part = name_leaf(leaf, what), "part " if leaf.supported and leaf.path else ""
                message = f"{name} is {part}of a {kind}; SB3 has no network for it"
                yield RuleFinding("RL109", message, {"element": name, "value": kind})
                break


def _unsupported_kind(leaf: Leaf, depth: int) -> str:
    if not leaf.supported:
        return f"{leaf.kind} space"
    if any(isinstance(key, int) for key in leaf.path):
        return "Tuple space"
    if len(leaf.path) > depth:
        return "nested Dict space" if depth else "Dict space"
    if leaf.kind == "MultiDiscrete" and len(leaf.shape) > 1:
        return "MultiDiscrete space of several axes"
    if leaf.kind in ("Discrete", "MultiDiscrete") and np.any(leaf.low):
        return f"{leaf.kind} space that does not count from 0"
    return ""
