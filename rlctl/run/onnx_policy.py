"""Exported policies on onnxruntime. Imports neither torch nor SB3."""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.dict_spaces import Observations, split, split_space
from rlctl.env_spec import LARGEST_SPACE
from rlctl.errors import ArtifactError, UsageError, short_repr
from rlctl.run import memory, onnx_file, untrusted
from rlctl.run.onnx_file import METADATA_KEY
from rlctl.run.policy import ROWS, Policy, PolicyInfo, State, parse_info

SINGLE_INPUT = "obs"
"""Name of the input of an observation that is not a dictionary; those of a dictionary are named by their keys."""
ACTION = "action"
STATE_INPUTS = ("state_h", "state_c")
"""LSTM state of a recurrent policy, each of shape (layers, batch, hidden); zeros when an episode begins."""
STATE_OUTPUTS = ("state_h_out", "state_c_out")
"""The LSTM state for the next step."""

_FATAL_ONLY = 4
_LARGEST = 2 * 2**30  # [bytes] of a file, the most that its format can hold
_MEMORY = 2 * 2**30  # [bytes]


class OnnxPolicy(Policy):
    """An ONNX file written by `rlctl export`, with the description it carries. Deterministic."""

    def __init__(self, info: PolicyInfo, session: onnxruntime.InferenceSession) -> None:
        super().__init__(info)
        self.session = session
        self._fields = _fields(self.observation_space)
        inputs = {each.name: each.shape for each in session.get_inputs()}
        for name, (shape, _) in self._fields.items():
            if inputs.get(name, [None])[1:] != list(shape):
                raise ValueError(f"no input {name!r} of shape {('batch', *shape)}")
        self._recurrent = STATE_INPUTS[0] in inputs
        if self._recurrent:
            layers, _, hidden = inputs[STATE_INPUTS[0]]
            self._state_size = (int(layers), int(hidden))
            if math.prod(self._state_size) > LARGEST_SPACE:
                raise ValueError(f"a state of {layers} layers of {hidden}")
        self._outputs = [ACTION, *STATE_OUTPUTS] if self._recurrent else [ACTION]
        self._state = self._make_state(1)

    @classmethod
    def load(cls, path: Path) -> OnnxPolicy:
        """Read an exported file; raises `ArtifactError` if it is missing, damaged, not ours or of a newer format."""
        session, metadata = _open_session(path)
        text = metadata.get(METADATA_KEY)
        if text is None:
            raise ArtifactError(
                f"{path}: not an ONNX file of rlctl: its metadata has no {METADATA_KEY!r} entry; "
                "make one with rlctl export --onnx"
            )
        info = parse_info(text, path)
        try:
            policy = cls(info, session)
            policy.try_once()
        except (ArtifactError, ValueError, TypeError, LookupError, MemoryError) as error:
            problem = short_repr(str(error), 200)
            raise ArtifactError(f"{path}: its graph does not fit its description: {problem}; export it again") from None
        return policy

    def initial_state(self) -> State | None:
        """Return zeros for `ROWS` episodes; None for a policy without a state."""
        return self._make_state(ROWS)

    def forward(
        self, observations: Observations, state: State | None, deterministic: bool
    ) -> tuple[NDArray[Any], State | None]:
        """Return the actions for `ROWS` observations and the next state; deterministic only."""
        parts = {key or SINGLE_INPUT: part for key, part in split(observations).items()}
        batch = {name: np.asarray(parts[name], dtype) for name, (_, dtype) in self._fields.items()}
        return self._run(batch, state, deterministic)

    def predict(self, observation: Any, *, deterministic: bool = True) -> NDArray[Any]:
        """Return the action for one observation, in a forward pass of one row.

        A recurrent policy remembers; call `reset` when an episode begins.
        """
        # A row costs less than the ROWS rows that keep an evaluation independent of its width.
        given = {key or SINGLE_INPUT: part for key, part in split(observation).items()}
        batch = {}
        for name, (shape, dtype) in self._fields.items():
            value = np.asarray(given[name], dtype) if name in given else np.empty(())
            if name not in given or value.shape != shape:
                raise ValueError(f"observation {name!r}: shape {value.shape}, the policy expects {shape}")
            batch[name] = value[None]
        actions, self._state = self._run(batch, self._state, deterministic)
        return np.asarray(actions[0])

    def reset(self) -> None:
        """Begin an episode: forget the recurrent state."""
        self._state = self._make_state(1)

    def _run(
        self, batch: dict[str, NDArray[Any]], state: State | None, deterministic: bool
    ) -> tuple[NDArray[Any], State | None]:
        if not deterministic:
            raise UsageError("an exported policy cannot sample: only its deterministic action is in the ONNX file")
        if state is not None:
            batch.update(zip(STATE_INPUTS, state, strict=True))
        try:
            actions, *after = self.session.run(self._outputs, batch)
        except Exception as error:  # onnxruntime's own errors have no public base class
            raise ArtifactError(f"the exported policy cannot act: {short_repr(str(error), 200)}") from None
        return actions, tuple(after) or None

    def _make_state(self, rows: int) -> State | None:
        if not self._recurrent:
            return None
        layers, hidden = self._state_size
        return tuple(np.zeros((layers, rows, hidden), np.float32) for _ in STATE_INPUTS)


def _open_session(path: Path) -> tuple[onnxruntime.InferenceSession, dict[str, str]]:
    """Return a session on a file, and the file's metadata."""
    content = untrusted.read_bytes(path, _LARGEST)
    try:
        onnx_file.check(content)
    except ValueError as error:
        raise ArtifactError(f"{path}: damaged, or not an ONNX file of rlctl: {error}") from None
    try:
        _limit_memory()
        session = onnxruntime.InferenceSession(content, _make_options(), providers=["CPUExecutionProvider"])
        return session, session.get_modelmeta().custom_metadata_map
    except Exception as error:  # onnxruntime's own errors have no public base class
        raise ArtifactError(
            f"{path}: damaged, or not an ONNX file that onnxruntime {onnxruntime.__version__} can read: "
            f"{short_repr(str(error), 200)}"
        ) from None


def _fields(space: spaces.Space[Any]) -> dict[str, tuple[tuple[int, ...], Any]]:
    """Shape and dtype of every input that is an observation."""
    return {key or SINGLE_INPUT: (part.shape or (), part.dtype) for key, part in split_space(space).items()}


@functools.cache
def _limit_memory() -> None:
    """Bound what all graphs of this process may take: a small file can ask for any amount."""
    there = memory.available()
    limit = _MEMORY if there is None else min(_MEMORY, there // 2)
    place = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    settings = dict.fromkeys(("arena_extend_strategy", "initial_chunk_size_bytes", "max_dead_bytes_per_chunk"), -1)
    onnxruntime.create_and_register_allocator(place, onnxruntime.OrtArenaCfg({"max_mem": limit, **settings}))


def _make_options() -> onnxruntime.SessionOptions:
    options = onnxruntime.SessionOptions()
    # These networks are too small to share among threads, and the result must not depend on the machine's cores.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.use_env_allocators", "1")  # which `_limit_memory` bounds
    options.log_severity_level = _FATAL_ONLY
    return options
