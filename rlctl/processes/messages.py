"""Messages between rlctl's own processes, pickled: rlctl's dataclasses and models, arrays, built-in types.

Nothing else is read this way: neither files nor anything from a network. A child process runs other people's code,
which may write to any descriptor, so the reader builds plain data only: it imports no other module and calls no other
function.
"""

from __future__ import annotations

import dataclasses
import enum
import io
import pickle
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

_BUILT_IN: dict[type, Any] = {
    str: str.__str__,
    int: int.__int__,
    float: float.__float__,
    complex: complex,
    bool: bool,
    tuple: tuple,
    list: list,
    dict: dict,
}
"""Per built-in type what makes one of an object of a subclass."""
_ARRAYS = {
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy._core.multiarray", "_reconstruct"),
}
"""What arrays are read with."""


class UnreadableMessageError(OSError):
    """What arrived is not a message."""


class _MessageWriter(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:
        """Send numbers, texts and containers of somebody else's classes as built-in ones; refuse other classes."""
        if isinstance(value, np.generic):
            plain = value.item()
            return type(plain), (plain,)
        if isinstance(value, np.ndarray) and type(value) is not np.ndarray:
            return np.asarray(value).__reduce_ex__(5)
        for kind, convert in _BUILT_IN.items():
            if isinstance(value, kind) and not _is_plain(type(value)):
                return kind, (convert(value),)
        if isinstance(value, type) and not _is_plain(value):
            raise TypeError(f"{value.__module__}.{value.__qualname__} cannot be sent: it is not plain data")
        return NotImplemented


class _MessageReader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Return a class of plain data; raises `UnpicklingError` for everything else, which stays unimported."""
        if module in ("rlctl", "builtins") or module.startswith("rlctl.") or (module, name) in _ARRAYS:
            value = super().find_class(module, name)
            if (module, name) in _ARRAYS or _is_plain(value):
                return value
        raise pickle.UnpicklingError(f"{module}.{name} is not plain data")


def _is_plain(kind: Any) -> bool:
    if kind in _BUILT_IN or kind in (np.ndarray, np.dtype):
        return True
    is_ours = isinstance(kind, type) and kind.__module__.startswith("rlctl.")
    return is_ours and (dataclasses.is_dataclass(kind) or issubclass(kind, enum.Enum) or hasattr(kind, "model_fields"))


def encode(message: Any) -> bytes:
    """Return a message as bytes; raises `TypeError` for what is not plain data."""
    buffer = io.BytesIO()
    _MessageWriter(buffer, protocol=5).dump(message)
    return buffer.getvalue()


def decode(content: bytes) -> Any:
    """Return the message of some bytes; raises `UnreadableMessageError` for anything else."""
    try:
        return _MessageReader(io.BytesIO(content)).load()
    except Exception as error:  # what the bytes happen to say
        raise UnreadableMessageError(f"not a message of rlctl ({error})") from None


def send(connection: Connection, message: Any) -> None:
    """Send a message; raises `OSError` if nobody can receive it."""
    connection.send_bytes(encode(message))


def receive(connection: Connection) -> Any:
    """Wait for a message; raises `EOFError` at the end of the connection, `OSError` if it is broken."""
    return decode(connection.recv_bytes())
