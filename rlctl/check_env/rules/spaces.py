"""RL1: spaces that learners can use."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import Seen, Severity, rule
from rlctl.check_env.rules.known import built

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
    for leaf in built(evidence).action_leaves:
        if leaf.kind != "Box" or leaf.low is None or leaf.high is None:
            continue
        if not (np.isfinite(leaf.low).all() and np.isfinite(leaf.high).all()):
            continue
        low, high = float(leaf.low.min()), float(leaf.high.max())
        if (leaf.low != -1).any() or (leaf.high != 1).any():
            message = f"actions are in [{low:g}, {high:g}], not in [-1, 1]"
            yield Seen(message, {"value": [low, high], "expected": [-1.0, 1.0]})
        elif leaf.dtype != "float32":
            yield Seen(f"actions are {leaf.dtype}", {"value": leaf.dtype, "expected": "float32"})


@rule(
    "RL108",
    "image conventions",
    WARNING,
    "Images: uint8 in [0, 255], three axes, at least 36 x 36. Anything else: flatten to one axis.",
    complaints=(r"seems that your observation", r"minimal resolution for an image", r"unconventional shape"),
    only_complaints=True,
)
def images(evidence: Evidence) -> Iterator[Seen]:
    """An observation looks like an image, or like neither image nor vector, and the default networks will treat it
    in a way that does not fit."""
    return iter(())


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
