"""The beginning of the graph: raw observations to the features a network starts from."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.errors import UsageError
from rlctl.export.graph import BATCH, Graph
from rlctl.export.layers import emit
from rlctl.run.onnx_policy import SINGLE_INPUT
from rlctl.run.policy import PolicyInfo
from rlctl.run.torch_policy import NORMALIZE_EPSILON, network_space

if TYPE_CHECKING:
    import torch

Tensors = dict[str, NDArray[Any]]


def emit_features(
    graph: Graph, info: PolicyInfo, tensors: Tensors, extractor: torch.nn.Module, scale_images: bool
) -> str:
    """Add the inputs, their normalisation, what SB3 does before a network, and the features extractor.

    Returns the features, shape (batch, features). `tensors` are a policy file's; `scale_images` is SB3's
    `normalize_images`.
    """
    space, _ = info.env.spaces()
    seen = network_space(space)
    if not isinstance(space, spaces.Dict):
        value = _input(graph, SINGLE_INPUT, space, _meaning(info))
        value = _prepared(graph, value, "", space, seen, info, tensors, scale_images)
        return _extracted(graph, value, extractor, "features_extractor")
    if type(extractor).__name__ != "CombinedExtractor":
        raise UsageError(f"export: features extractor {type(extractor).__name__} cannot be written as ONNX yet")
    inputs = {key: _input(graph, key, each, f"observation {key!r}") for key, each in space.spaces.items()}
    parts = []
    for key, each in extractor.extractors.items():  # type: ignore[operator, union-attr]
        value = _prepared(
            graph, inputs[key], key, space[key], seen[key], info, tensors, scale_images  # type: ignore[index]
        )
        parts.append(_extracted(graph, value, each, f"features_extractor.{key}"))
    return graph.add("Concat", *parts, axis=1) if len(parts) > 1 else parts[0]


def _meaning(info: PolicyInfo) -> str:
    units = info.env.observation_units
    parts = [
        f"{name} ({size}) [{units[name]}]" if name in units else f"{name} ({size})"
        for name, size in info.env.observation_sizes.items()
    ]
    return ", ".join(parts) or "observation"


def _input(graph: Graph, name: str, space: spaces.Space[Any], meaning: str) -> str:
    if space.shape is None or space.dtype is None:
        raise UsageError(f"export: observation {name!r} is a {type(space).__name__}, which cannot be written as ONNX yet")
    return graph.input(name, space.dtype, (BATCH, *space.shape), meaning)


def _prepared(
    graph: Graph,
    value: str,
    key: str,
    space: spaces.Space[Any],
    seen: spaces.Space[Any],
    info: PolicyInfo,
    tensors: Tensors,
    scale_images: bool,
) -> str:
    """From the environment's observation to what SB3's `preprocess_obs` gives: normalised, float32, one-hot."""
    if key in info.normalized_keys:
        value = _normalized(graph, value, key, info, tensors)
    elif isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        return _one_hot(graph, value, key, space)
    if space.shape != seen.shape:  # an image with its channels last, which torch wants first
        value = graph.add("Transpose", value, perm=[0, 3, 1, 2])
    if key not in info.normalized_keys and space.dtype != np.float32:
        value = graph.cast(value, np.float32)
    if scale_images and _is_image(space):
        value = graph.add("Div", value, graph.constant(f"image/{key}", np.float32(255.0)))
    return value


def _is_image(space: spaces.Space[Any]) -> bool:
    """What SB3 takes for an image."""
    return (
        isinstance(space, spaces.Box)
        and space.dtype == np.uint8
        and len(space.shape) == 3
        and bool((space.low == 0).all() and (space.high == 255).all())
    )


def _normalized(graph: Graph, value: str, key: str, info: PolicyInfo, tensors: Tensors) -> str:
    # As VecNormalize, in float64: an element that hardly varies is multiplied by up to 10,000, and so would be
    # the rounding of float32.
    mean, variance = tensors[f"normalize/{key}/mean"], tensors[f"normalize/{key}/var"]
    clip = float(info.clip_observation or np.inf)
    value = graph.cast(value, np.float64)
    value = graph.add("Sub", value, graph.constant(f"normalize/{key}/mean", np.float64(mean)))
    deviation = np.sqrt(np.float64(variance) + NORMALIZE_EPSILON)
    value = graph.add("Div", value, graph.constant(f"normalize/{key}/deviation", deviation))
    low, high = (graph.constant(f"normalize/{key}/{name}", np.float64(x)) for name, x in (("low", -clip), ("high", clip)))
    return graph.cast(graph.add("Clip", value, low, high), np.float32)


def _one_hot(graph: Graph, value: str, key: str, space: spaces.Discrete | spaces.MultiDiscrete) -> str:
    levels = graph.constant(f"one_hot/{key}/levels", np.array([0.0, 1.0], np.float32))
    if isinstance(space, spaces.Discrete):
        depth = graph.constant(f"one_hot/{key}/depth", np.int64(space.n))
        return graph.add("OneHot", value, depth, levels)
    parts = []
    for index, size in enumerate(space.nvec.tolist()):
        column = graph.add("Gather", value, graph.constant(f"one_hot/{key}/{index}", np.int64(index)), axis=1)
        parts.append(graph.add("OneHot", column, graph.constant(f"one_hot/{key}/{index}/depth", np.int64(size)), levels))
    return graph.add("Concat", *parts, axis=1) if len(parts) > 1 else parts[0]


def _extracted(graph: Graph, value: str, extractor: Any, name: str) -> str:
    if type(extractor).__name__ == "NatureCNN":
        value = emit(graph, value, extractor.cnn, f"{name}.cnn")
        return emit(graph, value, extractor.linear, f"{name}.linear")
    return emit(graph, value, extractor, name)
