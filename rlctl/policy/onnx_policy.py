"""Exported policies that act with onnxruntime. Imports neither torch nor SB3."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import LARGEST_SPACE, Observations, split
from rlctl.errors import ArtifactError, UsageError, short_repr
from rlctl.policy import onnx_file
from rlctl.policy.file import PolicyInfo, parse_info
from rlctl.policy.onnx_file import METADATA_KEY
from rlctl.policy.policy import Policy
from rlctl.storage import untrusted

SINGLE_INPUT = "obs"
"""Name of the input for an observation that is not a dictionary; a dictionary has one input per key."""
ACTION = "action"
STATE_INPUTS = ("state_h", "state_c")
"""LSTM state of a recurrent policy, each of shape (layers, batch, hidden); zeros when an episode begins."""
STATE_OUTPUTS = ("state_h_out", "state_c_out")  # the LSTM state for the next step

_FATAL_ONLY = 4
_LARGEST = 2 * 2**30  # [bytes], the limit of the format


class OnnxPolicy(Policy):
    """An ONNX file written by `rlctl export`, with its description. Deterministic."""

    def __init__(self, info: PolicyInfo, session: onnxruntime.InferenceSession) -> None:
        super().__init__(info)
        self.session = session
        inputs = {port.name: port.shape for port in session.get_inputs()}
        for key, (shape, _) in self._parts.items():
            if inputs.get(key or SINGLE_INPUT, [None])[1:] != list(shape):
                raise ValueError(f"no input {key or SINGLE_INPUT!r} of shape {('batch', *shape)}")
        self._recurrent = STATE_INPUTS[0] in inputs
        if self._recurrent:
            layers, _, hidden = inputs[STATE_INPUTS[0]]
            self._state_size = (int(layers), int(hidden))
            if math.prod(self._state_size) > LARGEST_SPACE:
                raise ValueError(f"a state of {layers} layers of {hidden}")
        self._outputs = [ACTION, *STATE_OUTPUTS] if self._recurrent else [ACTION]
        self._state: dict[str, NDArray[np.float32]] = self._make_state(1)

    @classmethod
    def load(cls, path: Path) -> OnnxPolicy:
        """Read an exported file; raises `ArtifactError` if it is missing, damaged, not ours or of a newer format."""
        session, metadata = _open_session(path)
        text = metadata.get(METADATA_KEY)
        if text is None:
            raise ArtifactError(
                f"{path}: not an ONNX file of rlctl: its metadata has no {METADATA_KEY!r} entry; "
                "write one with rlctl export --onnx"
            )
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
            raise UsageError("an exported policy cannot sample: only its deterministic action is in the ONNX file")
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
        if not self._recurrent:
            return {}
        layers, hidden = self._state_size
        return {name: np.zeros((layers, rows, hidden), np.float32) for name in STATE_INPUTS}


def _open_session(path: Path) -> tuple[onnxruntime.InferenceSession, dict[str, str]]:
    """Return a session on a file, and the file's metadata."""
    content = untrusted.read_bytes(path, _LARGEST)
    try:
        onnx_file.check(content)
    except ValueError as error:
        raise ArtifactError(f"{path}: damaged, or not an ONNX file of rlctl: {error}") from None
    try:
        session = onnxruntime.InferenceSession(content, make_options(), providers=["CPUExecutionProvider"])
        return session, session.get_modelmeta().custom_metadata_map
    except Exception as error:  # onnxruntime's own errors have no public base class
        raise ArtifactError(
            f"{path}: damaged, or not an ONNX file that onnxruntime {onnxruntime.__version__} can read: "
            f"{short_repr(str(error), 200)}"
        ) from None


def make_options() -> onnxruntime.SessionOptions:
    """Return options for small networks: one thread."""
    options = onnxruntime.SessionOptions()
    # These networks are too small to share among threads, and the result must not depend on the machine's cores.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = _FATAL_ONLY
    return options
