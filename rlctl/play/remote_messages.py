"""Messages of the WebSocket protocol of openpi's policy server: msgpack, with arrays as maps; and JSON for curl."""

import json
from typing import Any

import msgpack
import numpy as np
from pydantic_core import to_jsonable_python

from rlctl.errors import short_repr

_ARRAY, _SCALAR = b"__ndarray__", b"__npgeneric__"
_KINDS = "biuf"


class MessageError(ValueError):
    """The bytes are not a valid message; the text gives the reason."""


def pack(value: Any) -> bytes:
    """Return a message: msgpack, in which an array is a map of its bytes, dtype and shape."""
    return bytes(msgpack.packb(value, default=_encode))


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.kind in _KINDS:
        return {_ARRAY: True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic) and value.dtype.kind in _KINDS:
        return {_SCALAR: True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"a {type(value).__name__} cannot be sent")


def unpack(content: bytes) -> Any:
    """Decode a message. Raises `MessageError` for invalid msgpack, a repeated key, or an unsupported dtype."""
    try:
        return msgpack.unpackb(content, object_pairs_hook=_decode, strict_map_key=True)
    except MessageError:
        raise
    except Exception as error:  # msgpack has several, one of them without a public base class
        raise MessageError(f"not msgpack: {short_repr(str(error) or type(error).__name__)}") from None


def _decode(pairs: list[tuple[Any, Any]]) -> Any:
    content = _join(pairs)
    if _ARRAY in content:
        return _decode_array(content)
    if _SCALAR in content:
        return _check_dtype(content.get(b"dtype")).type(content.get(b"data"))
    return content


def _decode_array(content: dict[Any, Any]) -> Any:
    dtype = _check_dtype(content.get(b"dtype"))
    try:
        return np.frombuffer(content[b"data"], dtype).reshape(tuple(content[b"shape"]))
    except (KeyError, TypeError, ValueError):
        shape = short_repr(content.get(b"shape"))
        raise MessageError(f"the data of an array does not have shape {shape} and dtype {dtype}") from None


def _check_dtype(text: Any) -> np.dtype[Any]:
    try:
        if isinstance(text, str) and (dtype := np.dtype(text)).kind in _KINDS:
            return dtype
    except (TypeError, ValueError):
        pass
    raise MessageError(f"unsupported array dtype {short_repr(text)}; supported are bool, int, uint and float")


def parse_json(content: bytes) -> Any:
    """Decode JSON. Raises `MessageError` for invalid JSON or a repeated key."""
    try:
        return json.loads(content, object_pairs_hook=_join)
    except MessageError:
        raise
    except (ValueError, RecursionError) as error:
        raise MessageError(f"not JSON: {short_repr(str(error))}") from None


def _join(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        names = [name for name, _ in pairs]
        repeated = next(name for name in names if names.count(name) > 1)
        raise MessageError(f"key {short_repr(repeated)} is given twice")
    return content


def as_json(value: Any) -> Any:
    """Return plain data for JSON: arrays become lists, non-finite numbers None."""
    return to_jsonable_python(value, inf_nan_mode="null", fallback=lambda array: array.tolist())
