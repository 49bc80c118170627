"""How a child process sends what it saw: a JSON header and arrays in one `.npz`; nothing is pickled."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_HEADER = "header"

Message = tuple[dict[str, Any], dict[str, NDArray[Any]]]


def encode(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return a message as bytes."""
    buffer = io.BytesIO()
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(buffer, allow_pickle=False, **{_HEADER: text}, **arrays)
    return buffer.getvalue()


def decode(content: bytes) -> Message:
    """Return the header and the arrays of a message."""
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    return json.loads(arrays.pop(_HEADER).tobytes()), arrays


def skip(study: str, reason: str) -> Message:
    """Return the message that a study, or a part of it, was left out."""
    return {"type": "skipped", "role": study, "reason": reason}, {}


def result(value: DataclassInstance) -> Message:
    """Return the message that carries a study's result, one of the dataclasses in `results`."""
    return {"type": "result", "kind": type(value).__name__, "content": dataclasses.asdict(value)}, {}
