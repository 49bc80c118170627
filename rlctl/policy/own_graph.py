"""A user's network in a policy file: an ONNX graph from an observation to the last hidden layer.

onnxruntime plays it, so acting needs neither torch nor the user's module. The weights are inputs of the graph and have
the names of the policy file's tensors: new weights in shared memory take effect at once.
"""

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

OBSERVATION = "observation/"  # prefix of the inputs for the parts of an observation; the key of the part follows
OUTPUT = "latent"


class OwnGraph:
    """Computes the last hidden layer for an observation; raises `ValueError` for a graph that does not load."""

    def __init__(self, tensors: Tensors, normalize: Mapping[str, Normalize]) -> None:
        self.content = np.asarray(tensors[GRAPH], np.uint8).tobytes()
        onnx_file.check(self.content)
        self.normalize = normalize  # by key of the part of an observation
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
        """Prepare the normalisation; call it again when its statistics have changed."""
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
