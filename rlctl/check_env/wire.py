"""How a child process sends what it has found: dataclasses as JSON, arrays as bytes behind it; nothing is pickled."""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PACKAGE = __name__.rpartition(".")[0]


def encode(message: Any) -> bytes:
    """Return a dataclass of this package as bytes; it may hold others, arrays, and what JSON can hold."""
    arrays: list[NDArray[Any]] = []
    plain = _to_plain(message, arrays)
    header = json.dumps([plain, [[each.dtype.str, each.shape] for each in arrays]]).encode()
    return b"".join([struct.pack("<q", len(header)), header, *(each.tobytes() for each in arrays)])


def decode(content: bytes) -> Any:
    """Return the dataclass that `encode` was given."""
    (length,) = struct.unpack_from("<q", content)
    start = 8 + length
    plain, forms = json.loads(content[8:start])
    arrays = []
    for kind, shape in forms:
        array = np.frombuffer(content, kind, math.prod(shape), start).reshape(shape)
        arrays.append(array.copy())  # its own memory, which can be written
        start += array.nbytes
    return _from_plain(plain, arrays)


def _to_plain(value: Any, arrays: list[NDArray[Any]]) -> Any:
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError(f"an array of {value.dtype} cannot be sent")
        arrays.append(value)
        return {"array": len(arrays) - 1}
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


def _from_plain(value: Any, arrays: Sequence[NDArray[Any]]) -> Any:
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
