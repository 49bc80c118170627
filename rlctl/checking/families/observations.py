"""RL1: spaces that learners can use; observations inside them; numbers that say nothing, jump, or are large."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiment import RECORDING, judges_records
from rlctl.checking.families.rewards import WITH_SEARCH
from rlctl.checking.observations import name_moment
from rlctl.checking.records import CheckedEpisode, Form, Records, Series
from rlctl.checking.rule import NotJudged, RuleFinding, Severity, list_names
from rlctl.environments.leaves import Leaf, name_leaf

ROUNDING = 1e-6  # Excess over a bound, relative to the bound, up to which it is float rounding
LARGE_SHARE, SMALL_SHARE = 0.1, 0.005  # of all observations but the last ones, for an error, or a warning
OFF_CENTRE = 0.05  # part of the range that zero may be off its middle, for an info
SMALLEST_SIDE = 36  # smaller images do not fit the default network's filters [pixels]
FEWEST_ROWS, FEWEST_SEEDS, FEWEST_JUMPS = 50, 3, 2
NEAR_TURN, SMALL_TURN = 1.0, 1.5  # a step of an angle is 2 pi +- NEAR_TURN, or small [rad]
LARGE_SIZE = 100.0  # root mean square; networks expect inputs around 1


def _forms(records: Records) -> Iterator[tuple[int, Leaf, CheckedEpisode, Form]]:
    leaves = records.require_built().leaves
    for episode, form in sorted(records.forms("observation"), key=lambda pair: pair[1].leaf or 0):
        index = form.leaf or 0
        if leaves[index].supported:
            yield index, leaves[index], episode, form


@judges_records("RL101")
def _find_wrong_shape(records: Records) -> Iterator[RuleFinding]:
    reported = set()
    for index, leaf, trajectory, form in _forms(records):
        if index not in reported and (what := _wrong_shape(leaf, form)):
            reported.add(index)
            shape = None if form.shape is None else list(form.shape)
            message = f"{name_leaf(leaf)} {name_moment(form.step)} {what}"
            evidence = trajectory.at(form.step, type=form.type, shape=shape, expected=list(leaf.shape))
            yield RuleFinding("RL101", message, evidence)
    for trajectory, form in records.forms("keys")[:1]:
        message = f"observation has the keys {form.type}; the space has other keys"
        yield RuleFinding("RL101", message, trajectory.at(form.step))


def _wrong_shape(leaf: Leaf, form: Form) -> str:
    if form.type == "missing":
        return f"is missing; the space has shape {leaf.shape}"
    if form.shape != leaf.shape:
        what = f"has shape {form.shape}" if form.shape is not None else f"is not an array but a {form.type}"
        return f"{what}; the space has shape {leaf.shape}"
    return f"is a {form.type}, not a numpy array" if form.type in ("list", "tuple") else ""


@judges_records("RL102")
def _find_wrong_dtype(records: Records) -> Iterator[RuleFinding]:
    wrong = [record for record in _forms(records) if _has_wrong_dtype(record[1], record[3])]
    parts = len({index for index, *_ in wrong})
    for _, leaf, trajectory, form in wrong[:1]:
        more = f"; {parts - 1} other parts differ too" if parts > 1 else ""
        message = f"{name_leaf(leaf)} {name_moment(form.step)} is {form.dtype}; the space is {leaf.dtype}{more}"
        evidence = trajectory.at(form.step, dtype=form.dtype, expected=leaf.dtype)
        is_number = np.dtype(form.dtype).kind in "biuf"
        yield RuleFinding("RL102", message, evidence, Severity.WARNING if is_number else Severity.ERROR)


def _has_wrong_dtype(leaf: Leaf, form: Form) -> bool:
    if form.dtype is None or form.shape != leaf.shape or form.type in ("list", "tuple"):
        return False
    dtype, declared = np.dtype(form.dtype), np.dtype(leaf.dtype)
    if leaf.kind != "Box":
        return dtype.kind not in "iub"
    return dtype != declared and not (form.type in ("float", "int") and leaf.shape == ())


@judges_records("RL103")
def _find_out_of_range(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    for index, leaf in enumerate(built.leaves):
        recorded = [(*pair, _excess(leaf, pair[1])) for pair in records.series(index) if leaf.supported]
        if not any(excess.any() for *_, excess in recorded):
            continue
        trajectory, series, excess = max(recorded, key=lambda record: float(record[2].max(initial=0.0)))
        row, flat = divmod(int(excess.argmax()), excess.shape[1])
        step, value = int(series.steps[row]), float(series.rows[row, flat])
        low, high = (float(bound[flat]) for bound in leaf.flat_bounds)
        bound = low if value < low else high
        is_rounding = np.dtype(leaf.dtype).kind == "f" and abs(value - bound) <= ROUNDING * max(abs(bound), 1e-3)
        outside = np.concatenate([excess.any(axis=1) for *_, excess in recorded])
        count, total = int(outside.sum()), len(outside)
        element = built.element(index, flat)
        columns = np.flatnonzero(np.any([record[2].any(axis=0) for record in recorded], axis=0))
        others = [built.element(index, int(column)) for column in columns if column != flat]
        more = f"; so are {list_names(others)}" if others else ""
        allowed = f"the space allows [{low:.9g}, {high:.9g}]{' (float rounding)' if is_rounding else ''}"
        share = f"{count} of {total} observations are outside{more}"
        message = f"{element} is {value:.9g} {name_moment(step)}; {allowed}; {share}"
        counts = {"observations_outside": count, "observations": total}
        evidence = trajectory.at(step, element=element, value=value, expected=[low, high], **counts)
        severity = Severity.WARNING if is_rounding else _severity_of_outside(recorded, outside)
        yield RuleFinding("RL103", message, evidence, severity)


def _severity_of_outside(
    recorded: list[tuple[CheckedEpisode, Series, NDArray[np.float64]]], outside: NDArray[np.bool_]
) -> Severity:
    is_first = np.concatenate([series.steps == 0 for _, series, _ in recorded])
    is_last = np.concatenate([(series.steps == episode.steps) & episode.has_ended for episode, series, _ in recorded])
    share = float((outside & ~is_last).mean())
    if share >= LARGE_SHARE or (outside & is_first).any():
        return Severity.ERROR
    return Severity.WARNING if share >= SMALL_SHARE else Severity.INFO


def _excess(leaf: Leaf, series: Series) -> NDArray[np.float64]:
    """How far values are outside their bounds; 0 inside, and for NaN, which is another rule's. Shape: (n, elements)."""
    (low, high), rows = leaf.flat_bounds, series.rows
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(rows), np.maximum(np.maximum(low - rows, rows - high), 0.0), 0.0)


@judges_records("RL105")
def _find_shared_memory(records: Records) -> Iterator[RuleFinding]:
    for trajectory, form in records.forms("memory")[:1]:
        name = name_leaf(records.require_built().leaves[form.leaf or 0])
        message = f"step {form.step} changed the {name} that the previous call had returned"
        yield RuleFinding("RL105", message, trajectory.at(form.step, steps=form.count))


@judges_records("RL106", "build")
def _find_unusual_actions(records: Records) -> Iterator[RuleFinding]:
    for leaf in records.require_built().action_leaves:
        if leaf.kind == "Box":
            yield from _unusual_actions(leaf)


def _unusual_actions(leaf: Leaf) -> Iterator[RuleFinding]:
    low, high = leaf.flat_bounds
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
            message = f"{int(wrong.sum())} of {wrong.size} actions {what}: action[{i}] is in [{low[i]:g}, {high[i]:g}]"
            evidence = {"element": f"action[{i}]", "value": [float(low[i]), float(high[i])], "expected": [-1.0, 1.0]}
            yield RuleFinding("RL106", message, evidence, severity)
            return
    if leaf.dtype != "float32":
        evidence = {"value": leaf.dtype, "expected": "float32"}
        yield RuleFinding("RL106", f"actions are {leaf.dtype}", evidence, Severity.INFO)


@judges_records("RL108", "build", *RECORDING)
def _find_unusual_images(records: Records) -> Iterator[RuleFinding]:
    for index, leaf in enumerate(records.require_built().leaves):
        name, shape = name_leaf(leaf), list(leaf.shape)
        if leaf.kind == "Box" and (problem := _image_problem(leaf)):
            yield RuleFinding("RL108", f"{name} {problem}", {"element": name, "value": shape, "dtype": leaf.dtype})
        elif leaf.kind == "Box" and _is_in_image_format(leaf) and (seen := records.series(index)):
            brightest = max(int(series.values.max(initial=0)) for _, series in seen)
            message = f"{name} is uint8 up to 255, and its brightest pixel was {brightest}: scaled twice?"
            if brightest <= 1:
                yield RuleFinding("RL108", message, {"element": name, "value": brightest, "expected": 255})


def _is_in_image_format(leaf: Leaf) -> bool:
    return len(leaf.shape) == 3 and leaf.dtype == "uint8" and bool(np.all(leaf.low == 0) and np.all(leaf.high == 255))


def _image_problem(leaf: Leaf) -> str:
    is_large = sum(size >= SMALLEST_SIDE for size in leaf.shape) >= 2
    is_table = len(leaf.shape) == 2 and leaf.dtype != "uint8"
    if is_large and not is_table and not _is_in_image_format(leaf):
        return f"is as large as an image, {leaf.shape}, and not (height, width, channels) of uint8 in [0, 255]"
    if _is_in_image_format(leaf) and not is_large:
        return f"has the shape of an image, {leaf.shape}, smaller than {SMALLEST_SIDE} x {SMALLEST_SIDE}"
    return ""


@judges_records("RL109", "build")
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


def _rows(records: Records, index: int) -> NDArray[np.float64]:
    recorded = records.series(index)
    if not recorded:
        raise NotJudged("no observation of the declared shape was recorded")
    rows = np.concatenate([series.rows for _, series in recorded])
    seeds = len({trajectory.seed for trajectory, _ in recorded})
    if len(rows) < FEWEST_ROWS or seeds < FEWEST_SEEDS:
        raise NotJudged(f"only {len(rows)} observations with {seeds} seeds were recorded")
    return rows


def _leaves(records: Records, kinds: str = "f") -> Iterator[tuple[int, Leaf]]:
    for index, leaf in enumerate(records.require_built().leaves):
        smallest = min(leaf.shape[0], leaf.shape[-1]) if leaf.shape else 0
        is_image = len(leaf.shape) == 3 and (leaf.dtype == "uint8" or smallest in (1, 3, 4))
        if leaf.supported and 0 not in leaf.shape and np.dtype(leaf.dtype).kind in kinds and not is_image:
            yield index, leaf


@judges_records("RL110", *WITH_SEARCH, of_absence=True)
def _find_constant_elements(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    names: list[str] = []
    total, has_constant_leaf = 0, False
    for index, leaf in _leaves(records, "biuf"):
        rows = _rows(records, index)
        constant = _constant(rows, leaf)
        total += rows.shape[1]
        has_constant_leaf |= np.dtype(leaf.dtype).kind == "f" and len(constant) == rows.shape[1]
        names += [f"{built.element(index, int(column))} ({float(rows[0, column]):.4g})" for column in constant]
    if names:
        message = f"{len(names)} of {total} elements of the observation never changed: {list_names(names)}"
        evidence = {"value": len(names), "expected": 0, "elements": [name.partition(" (")[0] for name in names[:8]]}
        is_likely = has_constant_leaf and total > 1  # masks, maps and the single number of a bandit seldom change
        yield RuleFinding("RL110", message, evidence, Severity.WARNING if is_likely else Severity.INFO)


def _constant(rows: NDArray[np.float64], leaf: Leaf) -> NDArray[np.intp]:
    """Return what never changes and could; of whole numbers, such as flags, only if none of the leaf does."""
    low, high = leaf.flat_bounds
    still = (rows == rows[0]).all(axis=0)
    if np.dtype(leaf.dtype).kind != "f" and not still.all():
        return np.zeros(0, np.intp)
    return np.flatnonzero(still & (low < high))


@judges_records("RL117", *WITH_SEARCH)
def _find_wrapped_angles(records: Records) -> Iterator[RuleFinding]:
    for index, _ in _leaves(records):
        rows = _rows(records, index)
        changes = np.concatenate([np.abs(np.diff(series.rows, axis=0)) for _, series in records.series(index)])
        jumps = np.abs(changes - 2 * np.pi) < NEAR_TURN
        is_angle = (np.abs(rows) <= 2 * np.pi).all(axis=0) & (jumps | (changes < SMALL_TURN)).all(axis=0)
        for column in np.flatnonzero(is_angle & (jumps.sum(axis=0) >= FEWEST_JUMPS))[:1]:
            name, count = records.require_built().element(index, int(column)), int(jumps[:, column].sum())
            message = f"{name} jumps by 2 pi in {count} of {len(changes)} steps: an angle that wraps"
            yield RuleFinding("RL117", message, {"element": name, "expected": "sin and cos"})


@judges_records("RL118", *WITH_SEARCH)
def _find_large_elements(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    large: dict[str, float] = {}
    for index, _ in _leaves(records):
        sizes = np.sqrt(np.mean(np.square(np.nan_to_num(_rows(records, index))), axis=0))
        large |= {built.element(index, int(i)): float(sizes[i]) for i in np.flatnonzero(sizes > LARGE_SIZE)}
    if large and not records.normalizes("observation"):
        names = [f"{name} ({size:.3g})" for name, size in sorted(large.items(), key=lambda pair: -pair[1])]
        message = f"elements of the observation are large (root mean square): {list_names(names)}"
        evidence = {"value": max(large.values()), "expected": f"up to {LARGE_SIZE:g}", "elements": list(large)[:8]}
        yield RuleFinding("RL118", message, evidence)
