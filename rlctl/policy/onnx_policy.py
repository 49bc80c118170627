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

from rlctl.environments.dict_spaces import split, split_space
from rlctl.errors import PLAY_OTHERS, ArtifactError, UsageError, short_repr
from rlctl.policy.actor import Array, Exploration, Rows, act_one_by_one
from rlctl.policy.file import GRAPH, PolicyInfo, Tensors, parse_info
from rlctl.policy.layers import Normalize
from rlctl.policy.policy import FileActor, Policy
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


class OnnxActor(FileActor):
    """An ONNX file written by `rlctl export`, with its description, in `count` environments. Deterministic."""

    def __init__(self, info: PolicyInfo, session: onnxruntime.InferenceSession, count: int = 1) -> None:
        self.info, self.session = info, session
        inputs = {port.name: port.shape for port in session.get_inputs()}
        self._types: dict[str, Any] = {}
        for key, space in split_space(info.env.spaces()[0]).items():
            shape, self._types[key] = space.shape or (), space.dtype
            if inputs.get(key or SINGLE_INPUT, [None])[1:] != list(shape):
                raise ValueError(f"no input {key or SINGLE_INPUT!r} of shape {('batch', *shape)}")
        self._is_recurrent = STATE_INPUTS[0] in inputs
        self._outputs = [ACTION, *STATE_OUTPUTS] if self._is_recurrent else [ACTION]
        layers, hidden = inputs[STATE_INPUTS[0]][::2] if self._is_recurrent else (0, 0)
        self._state = np.zeros((count, 2, layers, hidden), np.float32)

    @classmethod
    def load(cls, path: Path, count: int = 1) -> OnnxActor:
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
            actor = cls(info, session, count)
            Policy(actor).try_once()
        except (ArtifactError, ValueError, TypeError, LookupError, MemoryError) as error:
            problem = short_repr(str(error), 200)
            raise ArtifactError(f"{path}: its graph does not fit its description: {problem}; export it again") from None
        return actor

    @property
    def state(self) -> Array | None:
        """Hidden and cell states, shape (n, 2, layers, hidden); None without an LSTM."""
        return self._state if self._is_recurrent else None

    def explore(self, exploration: Exploration) -> None:
        """Raise `UsageError` for exploration: the file has only the deterministic action."""
        if exploration.stochastic:
            raise UsageError("an exported policy cannot sample: the ONNX file has only its deterministic action")

    def begin(self, rows: Rows) -> None:
        """Forget the recurrent states."""
        self._state[rows.index] = 0.0

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the deterministic actions; each row is a call, because the bits of a batch depend on its size."""
        return act_one_by_one(observations, rows, self._act_one)

    def _act_one(self, observation: Any, row: int, seed: int, step: int) -> Any:
        batch = {key: np.asarray(part)[None] for key, part in split(observation).items()}
        actions = self._run(batch, self._state[row : row + 1])
        if len(actions) != 1:
            raise ValueError(f"it returns {len(actions)} actions for one observation")
        return actions[0]

    def act_together(self, observations: Any) -> Array:
        """Return the actions for the first observations of several episodes, in one call."""
        batch = split(observations)
        count = len(next(iter(batch.values())))
        return self._run(batch, np.zeros((count, *self._state.shape[1:]), np.float32))

    def _run(self, batch: dict[str, Any], states: Array) -> Array:
        """Return the actions for a batch, and advance its states, shape (k, 2, layers, hidden)."""
        feed = {key or SINGLE_INPUT: np.asarray(batch[key], dtype) for key, dtype in self._types.items()}
        if self._is_recurrent:
            feed |= {name: states[:, part].swapaxes(0, 1) for part, name in enumerate(STATE_INPUTS)}
        actions, *after = _run_session(self.session, self._outputs, feed)
        for part, value in enumerate(after):
            states[:, part] = value.swapaxes(0, 1)
        return np.asarray(actions)


def _run_session(session: onnxruntime.InferenceSession, outputs: list[str], feed: dict[str, Any]) -> list[Array]:
    try:
        results: list[Array] = session.run(outputs, feed)
    except Exception as error:  # onnxruntime's own errors have no public base class
        raise ArtifactError(f"the exported policy cannot act: {short_repr(str(error), 200)}") from None
    return results


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

    def __call__(self, observations: Any) -> NDArray[Any]:
        """Return the latents, shape (k, size), of raw observations; a call for each row, as `OnnxActor` does."""
        parts = {key: split(observations)[key] for key in self._keys}
        parts |= {key: normalize(parts[key]) for key, normalize in self.normalize.items() if key in parts}
        count = len(next(iter(parts.values())))
        return np.concatenate([self._run(parts, k) for k in range(count)])

    def _run(self, parts: dict[str, Any], row: int) -> NDArray[Any]:
        inputs = {OWN_INPUT + key: np.asarray(part[row : row + 1]) for key, part in parts.items()}
        return _run_session(self._session, [OWN_OUTPUT], {**self.weights, **inputs})[0]
