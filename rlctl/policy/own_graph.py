"""A user's network as a policy file keeps it: an ONNX graph from an observation to the last hidden layer.

It is played by onnxruntime, so that neither torch nor the user's module is needed to act. The weights are inputs of the
graph with the names of the policy file's tensors: where these are in shared memory, new numbers act at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import split
from rlctl.policy import onnx_file
from rlctl.policy.file import GRAPH, Tensors
from rlctl.policy.layers import Normalize
from rlctl.policy.onnx_policy import make_options

OBSERVATION = "observation/"
"""Begins the names of the inputs for the parts of an observation, which end with their keys."""
OUTPUT = "latent"


class OwnGraph:
    """Computes the latent of one observation after the other; raises `ValueError` for a graph that is not sound."""

    def __init__(self, tensors: Tensors, normalize: Mapping[str, Normalize]) -> None:
        self.content = np.asarray(tensors[GRAPH], np.uint8).tobytes()
        onnx_file.check(self.content)
        self.normalize = normalize
        """The normalisation of the parts of an observation that have one."""
        try:
            self._session = onnxruntime.InferenceSession(
                self.content, make_options(), providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime's own errors have no public base class
            raise ValueError(f"its graph does not load: {error}") from None
        inputs = [port.name for port in (*self._session.get_inputs(), *self._session.get_overridable_initializers())]
        self.weights = {name: tensors[name] for name in inputs if not name.startswith(OBSERVATION)}
        self._keys = [name.removeprefix(OBSERVATION) for name in inputs if name.startswith(OBSERVATION)]

    def prepare(self) -> None:
        """Compute what follows from the statistics of the normalisation, again after they have changed."""
        for layer in self.normalize.values():
            layer.prepare()

    def __call__(self, observation: Any) -> NDArray[Any]:
        """Return the latent, shape (size,), of a raw observation."""
        parts, feed = split(observation), dict(self.weights)
        for key in self._keys:
            value = parts[key]
            if key in self.normalize:
                value = self.normalize[key](value)
            feed[OBSERVATION + key] = np.asarray(value)[None]
        result: NDArray[Any] = self._session.run([OUTPUT], feed)[0][0]
        return result
