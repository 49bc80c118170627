"""RL106 to RL109: spaces that learners can use."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rlctl.check_env.experiment import RECORDING, check
from rlctl.check_env.finding import Finding, Severity
from rlctl.check_env.leaves import Leaf, leaf_name
from rlctl.check_env.records import Records

COLOURS = (3, 4)
SMALLEST_SIDE = 36
"""An image with a shorter side does not fit through the default network's filters [pixels]."""


@check("RL106", "build")
def find_unusual_actions(records: Records) -> Iterator[Finding]:
    for leaf in records.require_built().action_leaves:
        if leaf.kind == "Box":
            yield from _unusual_actions(leaf)


def _unusual_actions(leaf: Leaf) -> Iterator[Finding]:
    low, high = np.ravel(np.asarray(leaf.low, np.float64)), np.ravel(np.asarray(leaf.high, np.float64))
    is_open = ~np.isfinite(low) | ~np.isfinite(high)
    is_thrust = (low == 0) & (high <= 1)  # or a pedal: by nature to one side
    for wrong, severity, what in (
        (is_open, Severity.ERROR, "have no finite bounds"),
        ((low != -high) & ~is_thrust, Severity.WARNING, "are not symmetric"),
        ((low != -1) | (high != 1), Severity.INFO, "are not in [-1, 1]"),
    ):
        if wrong.any():
            i = int(wrong.argmax())
            name = f"action[{i}]"
            message = f"{int(wrong.sum())} of {wrong.size} actions {what}: {name} is in [{low[i]:g}, {high[i]:g}]"
            evidence = {"element": name, "value": [float(low[i]), float(high[i])], "expected": [-1.0, 1.0]}
            yield Finding("RL106", message, evidence, severity)
            return
    if leaf.dtype != "float32":
        evidence = {"value": leaf.dtype, "expected": "float32"}
        yield Finding("RL106", f"actions are {leaf.dtype}", evidence, Severity.INFO)


@check("RL108", "build", *RECORDING)
def find_unusual_images(records: Records) -> Iterator[Finding]:
    for index, leaf in enumerate(records.require_built().leaves):
        if leaf.kind != "Box":
            continue
        name, shape = leaf_name(leaf), list(leaf.shape)
        if problem := _image_problem(leaf):
            evidence = {"element": name, "value": shape, "dtype": leaf.dtype}
            severity = Severity.WARNING if _looks_like_image(leaf) else Severity.INFO
            yield Finding("RL108", f"{name} has {problem}", evidence, severity)
        elif len(shape) == 3 and leaf.dtype == "uint8" and (brightest := _brightest(records, index)) in (0, 1):
            message = (
                f"{name} is uint8 up to 255, and no pixel of any episode is brighter than {brightest}: scaled twice?"
            )
            yield Finding("RL108", message, {"element": name, "value": brightest, "expected": 255})


def _image_problem(leaf: Leaf) -> str:
    """Say what is unusual about a space of more than one axis; nothing for an image, and for numbers of other kinds."""
    shape = tuple(leaf.shape)
    if len(shape) < 2 or (len(shape) == 2 and leaf.dtype != "uint8"):
        return ""
    if len(shape) != 3:
        return f"shape {shape}: {len(shape)} axes are neither a vector nor an image"
    if 1 not in (shape[0], shape[-1]) and not {shape[0], shape[-1]} & set(COLOURS) and leaf.dtype != "uint8":
        return f"shape {shape}: three axes, and neither the first nor the last of them counts colours"
    if leaf.dtype != "uint8":
        return f"the shape of an image, {shape}, and is {leaf.dtype}, not uint8"
    if np.any(leaf.low != 0) or np.any(leaf.high != 255):
        return f"the shape of an image, {shape}, and bounds other than 0 and 255"
    if sorted(shape)[1] < SMALLEST_SIDE:
        return f"the shape of an image, {shape}, smaller than {SMALLEST_SIDE} x {SMALLEST_SIDE}"
    return ""


def _looks_like_image(leaf: Leaf) -> bool:
    """Say whether a space is as large as a picture, or has the format that the default networks take for one."""
    is_format = (
        len(leaf.shape) == 3 and leaf.dtype == "uint8" and bool(np.all(leaf.low == 0) and np.all(leaf.high == 255))
    )
    return is_format or sum(size >= SMALLEST_SIDE for size in leaf.shape) >= 2


def _brightest(records: Records, index: int) -> int | None:
    episodes = [each.observations[index].values for each in records.require_alone() if index in each.observations]
    return max((int(values.max()) for values in episodes if values.size), default=None)


@check("RL109", "build")
def find_unsupported_spaces(records: Records) -> Iterator[Finding]:
    built = records.require_built()
    for what, leaves, depth in (("observation", built.leaves, 1), ("action", built.action_leaves, 0)):
        for leaf in leaves:
            if not leaf.supported:
                kind = leaf.kind
            elif any(isinstance(key, int) for key in leaf.path):
                kind = "Tuple"
            elif len(leaf.path) > depth:
                kind = "nested Dict" if depth else "Dict"
            else:
                continue
            name = what + leaf_name(leaf).removeprefix("observation")
            message = f"{name} is {'part ' if leaf.supported else ''}of a {kind} space; SB3 has no network for it"
            yield Finding("RL109", message, {"element": name, "value": kind})
            break
