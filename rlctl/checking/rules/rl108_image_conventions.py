"""RL108: image conventions."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import RECORDING, judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments.leaves import Leaf, name_leaf

RULE = Rule(
    "RL108",
    "image conventions",
    Severity.WARNING,
    meaning="""
        An observation looks like an image but does not follow the conventions, so the default networks do not
        treat it as one. They take three axes of uint8 in [0, 255] for an image, divide it by 255 and apply
        filters of 8 x 8; they flatten everything else.
    """,
    fix="""
        Images: Box(0, 255, (height, width, channels), np.uint8), at least 36 x 36. Anything else: flatten to
        one axis.
    """,
    is_about_space=True,
)

SMALLEST_SIDE = 36  # smaller images do not fit the default network's filters [pixels]


@judges_records(RULE, "build", *RECORDING)
def _find_unusual_images(records: Records) -> Iterator[RuleFinding]:
    for index, leaf in enumerate(records.require_built().leaves):
        name, shape = name_leaf(leaf), list(leaf.shape)
        if leaf.kind == "Box" and (problem := _image_problem(leaf)):
            yield RuleFinding(RULE, f"{name} {problem}", {"element": name, "value": shape, "dtype": leaf.dtype})
        elif leaf.kind == "Box" and _is_in_image_format(leaf) and (seen := records.series(index)):
            brightest = max(int(series.values.max(initial=0)) for _, series in seen)
            message = f"{name} is uint8 up to 255, and its brightest pixel was {brightest}: scaled twice?"
            if brightest <= 1:
                yield RuleFinding(RULE, message, {"element": name, "value": brightest, "expected": 255})


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
