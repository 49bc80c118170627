"""Where a network learns faster, on the CPU or on a GPU; docs/gpu.md has the measurements."""

import math
from collections.abc import Iterable, Sequence

MOST_WEIGHTS = 512 * 512
"""Weights of the largest layer that learns as fast on the CPU: a quarter of the 1024 x 1024 that take four times as
long there as on a GPU, because the CPU's time grows with the weights and the GPU's hardly does."""
_AXES_OF_CONVOLUTION = 4  # output and input channels, height, width


def find_fastest(shapes: Iterable[Sequence[int]], *, cuda_available: bool) -> tuple[str, str]:
    """Return the device, `cpu` or `cuda`, on which parameters of these shapes learn faster, and why."""
    shapes = list(shapes)
    if not cuda_available:
        return "cpu", "torch sees no GPU"
    if any(len(shape) == _AXES_OF_CONVOLUTION for shape in shapes):
        return "cuda", "the network has convolutions"
    largest = max((math.prod(shape) for shape in shapes), default=0)
    if largest > MOST_WEIGHTS:
        return "cuda", f"a layer has {largest:,} weights"
    return "cpu", "the network is small"


def describe_device(requested: str, fastest: str, reason: str, *, cuda_available: bool) -> str | None:
    """Return a line about the device of a training; None if there is nothing to choose.

    `requested` is the value of `--device`; `fastest` and `reason` are from `find_fastest`.
    """
    kind = requested.partition(":")[0]
    if not cuda_available or kind not in ("auto", "cpu", "cuda") or kind == fastest:
        return None
    if kind == "auto":
        return f"device: {fastest}, because {reason}"
    return f"device: {requested}; --device {fastest} is probably faster, because {reason} (docs/gpu.md)"
