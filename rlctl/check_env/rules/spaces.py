"""RL1: spaces that learners can use."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import Severity
from rlctl.check_env.leaves import Leaf, leaf_name
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.rules.known import built, lived

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO

NOT_NORMALISED = r"symmetric and normalized"


@rule(
    "RL106",
    "action space unbounded",
    ERROR,
    "Give the action space finite bounds, [-1, 1], and scale inside step().",
    complaints=(
        r"must have a finite lower and upper bound",
        r"Box action space (min|max)imum value is -?infinity",
        NOT_NORMALISED,
    ),
)
def bounded_actions(evidence: Evidence) -> Iterator[Seen]:
    """A continuous action has no bounds. Stable-Baselines3 refuses it: random and squashed actions need a range."""
    for leaf in built(evidence).action_leaves:
        if leaf.kind == "Box" and leaf.low is not None and leaf.high is not None:
            open_ends = int((~np.isfinite(leaf.low) | ~np.isfinite(leaf.high)).sum())
            if open_ends:
                message = f"{open_ends} of {leaf.low.size} actions have no finite bounds"
                yield Seen(message, {"value": open_ends, "expected": 0})


@rule(
    "RL107",
    "action space not normalised",
    INFO,
    "Declare Box(-1, 1, shape, np.float32) and scale to the real range inside step().",
    complaints=(NOT_NORMALISED, r"Your action space has dtype"),
)
def normalised_actions(evidence: Evidence) -> Iterator[Seen]:
    """A continuous action space is not [-1, 1]. Algorithms with an unsquashed Gaussian policy (PPO, A2C) start with
    actions of about that size: in another range they explore too little, or only at the bounds."""
    for leaf, low, high in _bounded(evidence):
        wrong = (low != -1) | (high != 1)
        if wrong.all():
            message = f"actions are in [{low.min():g}, {high.max():g}], not in [-1, 1]"
            yield Seen(message, {"value": [float(low.min()), float(high.max())], "expected": [-1.0, 1.0]})
        elif wrong.any():
            i = int(wrong.argmax())
            message = f"action[{i}] is in [{low[i]:g}, {high[i]:g}], not in [-1, 1] as others are"
            yield Seen(message, {"value": [float(low[i]), float(high[i])], "expected": [-1.0, 1.0]})
        elif leaf.dtype != "float32":
            yield Seen(f"actions are {leaf.dtype}", {"value": leaf.dtype, "expected": "float32"})


@rule(
    "RL113",
    "action space asymmetric",
    WARNING,
    "Declare Box(-1, 1, shape, np.float32) and map it to the real range inside step(), its middle to what does little.",
)
def symmetric_actions(evidence: Evidence) -> Iterator[Seen]:
    """Zero is not in the middle of a continuous action's range. A policy begins with actions around zero: it then
    begins off-centre, or at a bound, and explores one side only."""
    for _, low, high in _bounded(evidence):
        wrong = low != -high
        if wrong.any():
            i = int(wrong.argmax())
            message = f"{int(wrong.sum())} of {wrong.size} actions are not symmetric: action[{i}] is in "
            evidence_ = {"element": f"action[{i}]", "value": [float(low[i]), float(high[i])], "expected": "[-x, x]"}
            yield Seen(f"{message}[{low[i]:g}, {high[i]:g}]", evidence_)


def _bounded(evidence: Evidence) -> Iterator[tuple[Leaf, NDArray[np.float64], NDArray[np.float64]]]:
    """Yield the continuous parts of the action that have finite bounds, and these as vectors."""
    for leaf in built(evidence).action_leaves:
        if leaf.kind == "Box" and leaf.low is not None and leaf.high is not None:
            low, high = np.ravel(leaf.low).astype(np.float64), np.ravel(leaf.high).astype(np.float64)
            if np.isfinite(low).all() and np.isfinite(high).all():
                yield leaf, low, high


@rule(
    "RL108",
    "image conventions",
    WARNING,
    "Images: Box(0, 255, (height, width, channels), np.uint8), at least 36 x 36. Anything else: flatten to one axis.",
    complaints=(r"seems that your observation", r"minimal resolution for an image", r"unconventional shape"),
)
def images(evidence: Evidence) -> Iterator[Seen]:
    """An observation looks like an image, or like neither image nor vector, and the default networks will treat it
    in a way that does not fit: they take three axes of uint8 in [0, 255] for an image, divide it by 255 and look at
    it through filters of 8 x 8; they flatten the rest."""
    known = built(evidence)
    for index, leaf in enumerate(known.leaves):
        if leaf.kind != "Box" or leaf.low is None or leaf.high is None:
            continue
        name, shape = leaf_name(leaf), list(leaf.shape)
        if problem := _no_image(leaf, shape):
            yield Seen(f"{name} has {problem}", {"element": name, "value": shape, "dtype": leaf.dtype})
        elif len(shape) == 3 and leaf.dtype == "uint8" and (brightest := _brightest(evidence, index)) in (0, 1):
            message = (
                f"{name} is uint8 up to 255, and no pixel of any episode is brighter than {brightest}: scaled twice?"
            )
            yield Seen(message, {"element": name, "value": brightest, "expected": 255})


def _no_image(leaf: Leaf, shape: list[int]) -> str | None:
    """Say what is odd about the space of something with more than one axis; None for an image and for a vector."""
    if len(shape) < 2:
        return None
    if len(shape) != 3:
        return f"shape {tuple(shape)}: {len(shape)} axes are neither a vector nor an image"
    if 1 not in (shape[0], shape[-1]) and not {shape[0], shape[-1]} & {3, 4} and leaf.dtype != "uint8":
        return f"shape {tuple(shape)}: three axes, and neither the first nor the last of them counts colours"
    if leaf.dtype != "uint8":
        return f"the shape of an image, {tuple(shape)}, and is {leaf.dtype}, not uint8"
    if np.any(leaf.low != 0) or np.any(leaf.high != 255):
        return f"the shape of an image, {tuple(shape)}, and bounds other than 0 and 255"
    return None


def _brightest(evidence: Evidence, index: int) -> int | None:
    values = [each.observations[index].values for each in lived(evidence) if index in each.observations]
    return max((int(each.max()) for each in values if each.size), default=None)


@rule(
    "RL109",
    "space not supported for training",
    WARNING,
    "Use Box, Discrete, MultiDiscrete or MultiBinary, or one Dict of them for observations; wrappers in "
    "gymnasium.wrappers convert.",
    complaints=(r"not supported by Stable", r"not supported by SB3"),
    only_complaints=True,
)
def trainable_spaces(evidence: Evidence) -> Iterator[Seen]:
    """Stable-Baselines3 has no network for this kind of space."""
    return iter(())
