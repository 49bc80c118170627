"""Messages between rlctl's own processes, pickled: dataclasses and models of rlctl, arrays, built-in types.

Files and data from a network are never read this way. A child process runs third-party code, which may write to any
descriptor, so the reader creates plain data only: it imports no other module and calls no other function.
"""

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
"""Per built-in type the conversion of an object of a subclass."""
_ARRAYS = {
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy._core.multiarray", "_reconstruct"),
}
"""Names that pickled arrays refer to."""


_packages = {"rlctl"}
"""The packages whose dataclasses, enumerations and models are plain data."""


def trust_package(name: str) -> None:
    """Let messages contain dataclasses, enumerations and models of another package: of a command with processes.

    Call it where the classes are defined, because both processes must know it.
    """
    _packages.add(name)


class UnreadableMessageError(OSError):
    """The received bytes are not a message."""


class _MessageWriter(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:
        """Send numbers, strings and containers of third-party classes as built-in ones; refuse other classes."""
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
        """Return a class of plain data; raises `UnpicklingError` for everything else, without importing it."""
        if module == "builtins" or module.partition(".")[0] in _packages or (module, name) in _ARRAYS:
            value = super().find_class(module, name)
            if (module, name) in _ARRAYS or _is_plain(value):
                return value
        raise pickle.UnpicklingError(f"{module}.{name} is not plain data")


def _is_plain(kind: Any) -> bool:
    if kind in _BUILT_IN or kind in (np.ndarray, np.dtype):
        return True
    is_trusted = isinstance(kind, type) and kind.__module__.partition(".")[0] in _packages
    return is_trusted and (
        dataclasses.is_dataclass(kind) or issubclass(kind, enum.Enum) or hasattr(kind, "model_fields")
    )


def encode(message: Any) -> bytes:
    """Return a message as bytes; raises `TypeError` if it is not plain data."""
    buffer = io.BytesIO()
    _MessageWriter(buffer, protocol=5).dump(message)
    return buffer.getvalue()


def decode(content: bytes) -> Any:
    """Return the message in `content`; raises `UnreadableMessageError` if there is none."""
    try:
        return _MessageReader(io.BytesIO(content)).load()
    except Exception as error:  # arbitrary bytes may raise anything
        raise UnreadableMessageError(f"not a message of rlctl ({error})") from None


def send(connection: Connection, message: Any) -> None:
    """Send a message; raises `OSError` if the other end is closed."""
    connection.send_bytes(encode(message))


def receive(connection: Connection) -> Any:
    """Wait for a message; raises `EOFError` if the connection is closed, `OSError` if it is broken."""
    return decode(connection.recv_bytes())
