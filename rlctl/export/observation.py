"""The beginning of the graph: raw observations to the features a network starts from."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.export.graph import BATCH, Graph, unsupported
from rlctl.export.layers import emit
from rlctl.run.onnx_policy import SINGLE_INPUT
from rlctl.run.policy import PolicyInfo
from rlctl.run.torch_policy import NORMALIZE_EPSILON, network_space

Tensors = dict[str, NDArray[Any]]


@dataclasses.dataclass(frozen=True)
class Observations:
    """Adds to a graph what happens to observations before a policy's own layers."""

    graph: Graph
    info: PolicyInfo
    tensors: Tensors
    """A policy file's."""

    def features(self, extractor: Any, *, scale_images: bool) -> str:
        """Add inputs, normalisation, what SB3's `preprocess_obs` does, and the features extractor.

        Returns the features, shape (batch, features). `scale_images` is SB3's `normalize_images`.
        """
        space, _ = self.info.env.spaces()
        if not isinstance(space, spaces.Dict):
            value = self._add_input(SINGLE_INPUT, space, self._describe_input())
            return self._extract(self._prepare(value, "", space, scale_images), extractor, "features_extractor")
        if type(extractor).__name__ != "CombinedExtractor":
            raise unsupported(f"features extractor {type(extractor).__name__}")
        inputs = {key: self._add_input(key, each, f"observation {key!r}") for key, each in space.spaces.items()}
        parts = []
        for key, each in extractor.extractors.items():  # in the order the network was trained with
            value = self._prepare(inputs[key], key, space[key], scale_images)
            parts.append(self._extract(value, each, f"features_extractor.{key}"))
        return self._concatenate(parts)

    def _concatenate(self, parts: list[str]) -> str:
        return self.graph.add("Concat", *parts, axis=1) if len(parts) > 1 else parts[0]

    def _describe_input(self) -> str:
        sizes, units = self.info.env.observation_sizes, self.info.env.observation_units
        parts = [
            f"{name} ({size}) [{units[name]}]" if name in units else f"{name} ({size})" for name, size in sizes.items()
        ]
        return ", ".join(parts) or "observation"

    def _add_input(self, name: str, space: spaces.Space[Any], meaning: str) -> str:
        if space.shape is None or space.dtype is None:
            raise unsupported(f"observation {name!r}, a {type(space).__name__} space,")
        return self.graph.input(name, space.dtype, (BATCH, *space.shape), meaning)

    def _prepare(self, value: str, key: str, space: spaces.Space[Any], scale_images: bool) -> str:
        """From the environment's observation to what SB3's networks get: normalised, float32, one-hot."""
        if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
            return self._encode_one_hot(value, key, space)
        if key in self.info.normalized_keys:
            value = self._normalize(value, key)
        elif space.dtype != np.float32:
            value = self.graph.cast(value, np.float32)
        if space.shape != network_space(space).shape:  # an image with its channels last, which torch wants first
            value = self.graph.add("Transpose", value, perm=[0, 3, 1, 2])
        if scale_images and _is_image(space):
            value = self.graph.add("Div", value, self.graph.constant(f"image/{key}", np.float32(255.0)))
        return value

    def _normalize(self, value: str, key: str) -> str:
        # As VecNormalize, in float64: an element that hardly varies is multiplied by up to 10,000, and so would be
        # the rounding of float32.
        name, clip = f"normalize/{key}", float(self.info.clip_observation or np.inf)
        mean, variance = (np.float64(self.tensors[f"{name}/{part}"]) for part in ("mean", "var"))
        deviation = np.sqrt(variance + NORMALIZE_EPSILON)
        graph = self.graph
        value = graph.add("Sub", graph.cast(value, np.float64), graph.constant(f"{name}/mean", mean))
        value = graph.add("Div", value, graph.constant(f"{name}/deviation", deviation))
        low = graph.constant(f"{name}/low", np.float64(-clip))
        value = graph.add("Clip", value, low, graph.constant(f"{name}/high", np.float64(clip)))
        return graph.cast(value, np.float32)

    def _encode_one_hot(self, value: str, key: str, space: spaces.Discrete | spaces.MultiDiscrete) -> str:
        graph, name = self.graph, f"one_hot/{key}"
        levels = graph.constant(f"{name}/levels", np.array([0.0, 1.0], np.float32))
        if isinstance(space, spaces.Discrete):
            return graph.add("OneHot", value, graph.constant(f"{name}/depth", np.int64(space.n)), levels)
        parts = []
        for index, size in enumerate(space.nvec.tolist()):
            column = graph.add("Gather", value, graph.constant(f"{name}/{index}", np.int64(index)), axis=1)
            depth = graph.constant(f"{name}/{index}/depth", np.int64(size))
            parts.append(graph.add("OneHot", column, depth, levels))
        return self._concatenate(parts)

    def _extract(self, value: str, extractor: Any, name: str) -> str:
        if type(extractor).__name__ == "NatureCNN":
            value = emit(self.graph, value, extractor.cnn, f"{name}.cnn")
            return emit(self.graph, value, extractor.linear, f"{name}.linear")
        return emit(self.graph, value, extractor, name)


def _is_image(space: spaces.Space[Any]) -> bool:
    """What SB3 takes for an image."""
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8 or len(space.shape) != 3:
        return False
    return bool((space.low == 0).all() and (space.high == 255).all())
