"""ONNX graphs that act with onnxruntime: exported policies, and networks that a user writes. Imports no torch.

Every graph is checked before onnxruntime reads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import Observations, split
from rlctl.errors import PLAY_OTHERS, ArtifactError, UsageError, short_repr
from rlctl.policy.file import GRAPH, PolicyInfo, Tensors, parse_info
from rlctl.policy.layers import Normalize
from rlctl.policy.policy import Policy
from rlctl.storage import files, untrusted

if TYPE_CHECKING:
    import onnx

METADATA_KEY = "rlctl"  # metadata key of the policy's description
CONTROLLER_KEY = "rlctl_controller"  # metadata key of a controller, which is not a policy for the environment
DIGEST_KEY = "sha256"  # metadata key of the sha256 of the file's bytes, computed with zeros in place of the digest
SINGLE_INPUT = "obs"
"""Name of the input for an observation that is not a dictionary; a dictionary has one input per key."""
ACTION = "action"
STATE_INPUTS = ("state_h", "state_c")
"""LSTM state of a recurrent policy, each of shape (layers, batch, hidden); zeros when an episode begins."""
STATE_OUTPUTS = ("state_h_out", "state_c_out")  # the LSTM state for the next step
OWN_INPUT = "observation/"  # in a user's network: prefix of the inputs for the parts of an observation, before the key
OWN_OUTPUT = "latent"

_ZEROS = b"0" * 64
_FATAL_ONLY = 4


def encode(model: onnx.ModelProto) -> bytes:
    """Return the bytes of a model, with their sha256 in its metadata."""
    entry = next((entry for entry in model.metadata_props if entry.key == DIGEST_KEY), None)
    if entry is None:
        entry = model.metadata_props.add(key=DIGEST_KEY)
    entry.value = _ZEROS.decode()
    content: bytes = model.SerializeToString()
    return content.replace(_ZEROS, files.digest(content).encode())


def _parse(content: bytes) -> onnx.ModelProto:
    import onnx
    from google.protobuf.message import DecodeError

    try:
        return onnx.ModelProto.FromString(content)
    except DecodeError:
        raise ValueError("cut off, or not ONNX") from None


def _read_metadata(content: bytes) -> dict[str, str]:
    """Return the metadata of a graph; raises `ValueError` if it is damaged, or empty as text that parses is."""
    model = _parse(content)
    if not model.graph.node:
        raise ValueError("it has no graph")
    for entry in model.metadata_props:
        if not isinstance(entry.key, str) or not isinstance(entry.value, str):  # bytes, for damaged text
            raise ValueError("its metadata is not text")
    return {entry.key: entry.value for entry in model.metadata_props}


def check(content: bytes) -> None:
    """Raise `ValueError` for a graph that is damaged, or that has more than a policy needs.

    A loop may never end, and for a tensor in another file onnxruntime would read a path that the sender chose.
    """
    import onnx

    model = _parse(content)
    attributes = [attribute for node in model.graph.node for attribute in node.attribute]
    refused = [model.functions, model.training_info, model.graph.sparse_initializer]
    refused += [attribute.graphs or attribute.sparse_tensors for attribute in attributes]
    if any(refused) or any(attribute.HasField("g") or attribute.HasField("sparse_tensor") for attribute in attributes):
        raise ValueError("it has functions, loops, branches or sparse tensors, which no policy needs")
    inside = [tensor for attribute in attributes for tensor in (attribute.t, *attribute.tensors)]
    for tensor in (*model.graph.initializer, *inside):
        if tensor.external_data or tensor.data_location != onnx.TensorProto.DEFAULT:
            raise ValueError("one of its tensors is in another file")
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    if METADATA_KEY in metadata:
        digest = str(metadata.get(DIGEST_KEY, ""))  # protobuf returns bytes for damaged text
        if not digest or files.digest(content.replace(digest.encode(), _ZEROS)) != digest:
            raise ValueError("its content does not match its sha256")


def open_session(content: bytes) -> onnxruntime.InferenceSession:
    """Check a graph and load it into onnxruntime; raises `ValueError` if one of them refuses it."""
    check(content)
    options = onnxruntime.SessionOptions()
    # These networks are too small to share among threads, and the result must not depend on the machine's cores.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = _FATAL_ONLY
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own errors have no public base class
        problem = short_repr(str(error), 200)
        raise ValueError(f"onnxruntime {onnxruntime.__version__} cannot read it: {problem}") from None


class OnnxPolicy(Policy):
    """An ONNX file written by `rlctl export`, with its description. Deterministic."""

    def __init__(self, info: PolicyInfo, session: onnxruntime.InferenceSession) -> None:
        super().__init__(info)
        self.session = session
        inputs = {port.name: port.shape for port in session.get_inputs()}
        for key, (shape, _) in self._parts.items():
            if inputs.get(key or SINGLE_INPUT, [None])[1:] != list(shape):
                raise ValueError(f"no input {key or SINGLE_INPUT!r} of shape {('batch', *shape)}")
        self._state_shapes = {name: inputs[name] for name in STATE_INPUTS if name in inputs}
        self._outputs = [ACTION, *STATE_OUTPUTS] if self._state_shapes else [ACTION]
        self._state: dict[str, NDArray[np.float32]] = self._make_state(1)

    @classmethod
    def load(cls, path: Path) -> OnnxPolicy:
        """Read an exported file; raises `ArtifactError` if it is missing, damaged, foreign or of a newer format."""
        content = untrusted.read_bytes(path)
        try:
            metadata = _read_metadata(content)
        except ValueError as error:
            raise ArtifactError(f"{path}: damaged, or not an ONNX file: {error}") from None
        if CONTROLLER_KEY in metadata:
            raise ArtifactError(
                f"{path}: a controller takes what a robot measures; give the policy that it was made of"
            )
        text = metadata.get(METADATA_KEY)
        if text is None:
            raise ArtifactError(
                f"{path}: an ONNX file of another program: its metadata has no {METADATA_KEY!r} entry. {PLAY_OTHERS}"
            )
        try:
            session = open_session(content)
        except ValueError as error:
            raise ArtifactError(f"{path}: damaged: {error}") from None
        info = parse_info(text, path)
        try:
            policy = cls(info, session)
            policy.try_once()
        except (ArtifactError, ValueError, TypeError, LookupError, MemoryError) as error:
            problem = short_repr(str(error), 200)
            raise ArtifactError(f"{path}: its graph does not fit its description: {problem}; export it again") from None
        return policy

    def predict(self, observation: Any, *, deterministic: bool = True) -> NDArray[Any]:
        """Return the deterministic action for one observation; a recurrent state is kept until `reset`."""
        if not deterministic:
            raise UsageError("an exported policy cannot sample: the ONNX file has only its deterministic action")
        batch = {key or SINGLE_INPUT: part[None] for key, part in self.read_observation(observation).items()}
        (action,), *after = self._run({**batch, **self._state})
        self._state = dict(zip(self._state, after, strict=True))
        return np.asarray(action)

    def start_episodes(self, observations: Observations) -> NDArray[Any]:
        """Return the actions for the first observations of several episodes, in one call."""
        batch = {key or SINGLE_INPUT: part for key, part in split(observations).items()}
        count = len(next(iter(batch.values())))
        return np.asarray(self._run({**batch, **self._make_state(count)})[0])

    def reset(self) -> None:
        """Begin an episode: forget the recurrent state."""
        self._state = self._make_state(1)

    def _run(self, feed: dict[str, NDArray[Any]]) -> list[NDArray[Any]]:
        try:
            results: list[NDArray[Any]] = self.session.run(self._outputs, feed)
        except Exception as error:  # onnxruntime's own errors have no public base class
            raise ArtifactError(f"the exported policy cannot act: {short_repr(str(error), 200)}") from None
        return results

    def _make_state(self, rows: int) -> dict[str, NDArray[np.float32]]:
        shapes = self._state_shapes.items()
        return {name: np.zeros((layers, rows, hidden), np.float32) for name, (layers, _, hidden) in shapes}


class OwnGraph:
    """A user's network: computes the last hidden layer for an observation.

    Acting needs neither torch nor the user's module. The weights are inputs of the graph and have the names of the
    policy file's tensors: new weights in shared memory take effect at once. Raises `ValueError` for a graph that does
    not load.
    """

    def __init__(self, tensors: Tensors, normalize: Mapping[str, Normalize]) -> None:
        self.content = np.asarray(tensors[GRAPH], np.uint8).tobytes()
        self.normalize = normalize  # by key of the part of an observation
        self._session = open_session(self.content)
        inputs = [port.name for port in (*self._session.get_inputs(), *self._session.get_overridable_initializers())]
        self.weights = {name: tensors[name] for name in inputs if not name.startswith(OWN_INPUT)}
        self._keys = [name.removeprefix(OWN_INPUT) for name in inputs if name.startswith(OWN_INPUT)]

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
            feed[OWN_INPUT + key] = np.asarray(value)[None]
        return self._session.run([OWN_OUTPUT], feed)[0][0]
