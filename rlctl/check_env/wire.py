"""How a child process sends what it has found: dataclasses as JSON, arrays beside it in `.npz`; nothing is pickled."""

from __future__ import annotations

import dataclasses
import importlib
import io
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

_HEADER = "header"
_PACKAGE = __name__.rpartition(".")[0]


def encode(message: Any) -> bytes:
    """Return a dataclass of this package as bytes; it may hold others, arrays, and what JSON can hold."""
    arrays: dict[str, NDArray[Any]] = {}
    text = json.dumps(_to_plain(message, arrays)).encode()
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **{_HEADER: np.frombuffer(text, np.uint8)}, **arrays)
    return buffer.getvalue()


def decode(content: bytes) -> Any:
    """Return the dataclass that `encode` was given."""
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    return _from_plain(json.loads(arrays.pop(_HEADER).tobytes()), arrays)


def _to_plain(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    if isinstance(value, np.ndarray):
        name = f"array {len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if dataclasses.is_dataclass(value):
        fields = {field.name: _to_plain(getattr(value, field.name), arrays) for field in dataclasses.fields(value)}
        return {"class": f"{type(value).__module__}:{type(value).__name__}", "fields": fields}
    if isinstance(value, dict):  # its keys may be numbers
        return {"dict": [[key, _to_plain(each, arrays)] for key, each in value.items()]}
    if isinstance(value, tuple):
        return {"tuple": [_to_plain(each, arrays) for each in value]}
    if isinstance(value, list):
        return [_to_plain(each, arrays) for each in value]
    return value.item() if isinstance(value, np.generic) else value


def _from_plain(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    if isinstance(value, list):
        return [_from_plain(each, arrays) for each in value]
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return arrays[value["array"]]
    if "dict" in value:
        return {key: _from_plain(each, arrays) for key, each in value["dict"]}
    if "tuple" in value:
        return tuple(_from_plain(each, arrays) for each in value["tuple"])
    return _class(value["class"])(**{name: _from_plain(each, arrays) for name, each in value["fields"].items()})


def _class(name: str) -> type:
    """Return a dataclass of this package: what a child process names is not trusted further than that."""
    module, _, name = name.partition(":")
    found = getattr(importlib.import_module(module), name, None) if module.startswith(f"{_PACKAGE}.") else None
    if not (isinstance(found, type) and dataclasses.is_dataclass(found)):
        raise ValueError(f"{module}:{name} is not a dataclass of {_PACKAGE}")
    return found
