"""Reads what is written in a pickle as data: nothing in it is called, imported or made.

A pickle is a program for a small stack machine. This one runs its stacks and its memory of earlier values, but where
the program would import a name or call it, the name or the call itself is the value.
"""

from __future__ import annotations

import dataclasses
import pickletools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_OPCODES = 2_000_000
_DEEPEST = 50


class NotPlainData(ValueError):
    """A pickle holds what is not on the list of what is read, or is damaged."""


@dataclasses.dataclass(frozen=True)
class Name:
    """A class or function that a pickle refers to."""

    module: str
    qualname: str

    def __str__(self) -> str:
        return f"{self.module}.{self.qualname}"


@dataclasses.dataclass(eq=False)
class Call:
    """What calling a name would give; `state` is what would then be put into it, `items` what would be set in it."""

    function: Name
    arguments: tuple[Any, ...]
    state: Any = None
    items: dict[Any, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Persistent:
    """A reference to something beside the pickle, such as a tensor's storage."""

    content: Any


_MARK = object()
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_EMPTY: dict[str, Callable[[], Any]] = {"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_SET": set, "EMPTY_TUPLE": tuple}
_IGNORED = frozenset({"PROTO", "FRAME", "READONLY_BUFFER"})
_VALUES = frozenset(
    {
        *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
        *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"),
        *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
    }
)


def read(content: bytes) -> Any:
    """Return the value a pickle describes, of plain types, `Name`, `Call` and `Persistent`.

    Raises `NotPlainData` for a damaged pickle and for one that does what no model file does.
    """
    machine = _Machine()
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
            if count > MOST_OPCODES:
                raise NotPlainData(f"more than {MOST_OPCODES:,} instructions")
            if opcode.name == "STOP":
                return machine.stack.pop()
            machine.run(opcode.name, argument)
    except (IndexError, KeyError, TypeError, AttributeError, ValueError) as error:
        if isinstance(error, NotPlainData):
            raise
        raise NotPlainData(f"damaged: {error}") from None
    raise NotPlainData("damaged: it has no end")


class _Machine:
    def __init__(self) -> None:
        self.stack: list[Any] = []
        self._memory: dict[int, Any] = {}

    def run(self, name: str, argument: Any) -> None:
        if name in _VALUES:
            self.stack.append(argument)
        elif name in _CONSTANTS:
            self.stack.append(_CONSTANTS[name])
        elif name in _EMPTY:
            self.stack.append(_EMPTY[name]())
        elif name not in _IGNORED:
            handler = getattr(self, f"_run_{name.lower()}", None)
            if handler is None:
                raise NotPlainData(f"the instruction {name}, which no model file has")
            handler(argument)

    def _pop_to_mark(self) -> list[Any]:
        start = next(index for index in range(len(self.stack) - 1, -1, -1) if self.stack[index] is _MARK)
        items = self.stack[start + 1 :]
        del self.stack[start:]
        return items

    def _run_mark(self, _: Any) -> None:
        self.stack.append(_MARK)

    def _run_pop(self, _: Any) -> None:
        self.stack.pop()

    def _run_pop_mark(self, _: Any) -> None:
        self._pop_to_mark()

    def _run_dup(self, _: Any) -> None:
        self.stack.append(self.stack[-1])

    def _run_memoize(self, _: Any) -> None:
        self._memory[len(self._memory)] = self.stack[-1]

    def _run_put(self, index: int) -> None:
        self._memory[int(index)] = self.stack[-1]

    _run_binput = _run_long_binput = _run_put

    def _run_get(self, index: int) -> None:
        self.stack.append(self._memory[int(index)])

    _run_binget = _run_long_binget = _run_get

    def _run_tuple(self, _: Any) -> None:
        self.stack.append(tuple(self._pop_to_mark()))

    def _push_tuple(self, size: int) -> None:
        items = tuple(self.stack[-size:])
        del self.stack[-size:]
        self.stack.append(items)

    def _run_tuple1(self, _: Any) -> None:
        self._push_tuple(1)

    def _run_tuple2(self, _: Any) -> None:
        self._push_tuple(2)

    def _run_tuple3(self, _: Any) -> None:
        self._push_tuple(3)

    def _run_list(self, _: Any) -> None:
        self.stack.append(self._pop_to_mark())

    def _run_dict(self, _: Any) -> None:
        items = self._pop_to_mark()
        self.stack.append(dict(zip(items[::2], items[1::2], strict=True)))

    def _run_append(self, _: Any) -> None:
        value = self.stack.pop()
        self.stack[-1].append(value)

    def _run_appends(self, _: Any) -> None:
        items = self._pop_to_mark()
        self.stack[-1].extend(items)

    def _run_additems(self, _: Any) -> None:
        items = self._pop_to_mark()
        self.stack[-1].update(items)

    def _run_frozenset(self, _: Any) -> None:
        self.stack.append(frozenset(self._pop_to_mark()))

    def _run_setitem(self, _: Any) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._target()[key] = value

    def _run_setitems(self, _: Any) -> None:
        items = self._pop_to_mark()
        self._target().update(zip(items[::2], items[1::2], strict=True))

    def _target(self) -> Any:
        top = self.stack[-1]
        return top.items if isinstance(top, Call) else top

    def _run_global(self, argument: str) -> None:
        module, _, qualname = argument.partition(" ")
        self.stack.append(Name(module, qualname))

    def _run_stack_global(self, _: Any) -> None:
        qualname, module = self.stack.pop(), self.stack.pop()
        self.stack.append(Name(str(module), str(qualname)))

    def _run_reduce(self, _: Any) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        self._push_call(function, arguments)

    _run_newobj = _run_reduce

    def _run_newobj_ex(self, _: Any) -> None:
        keywords, arguments, function = self.stack.pop(), self.stack.pop(), self.stack.pop()
        self._push_call(function, (*arguments, keywords))

    def _push_call(self, function: Any, arguments: Any) -> None:
        if not isinstance(function, Name) or not isinstance(arguments, tuple):
            raise NotPlainData("a call of something that is not a name")
        self.stack.append(Call(function, arguments))

    def _run_build(self, _: Any) -> None:
        state = self.stack.pop()
        if not isinstance(self.stack[-1], Call):
            raise NotPlainData("a state for something that was not made by a call")
        self.stack[-1].state = state

    def _run_binpersid(self, _: Any) -> None:
        self.stack.append(Persistent(self.stack.pop()))


_RECONSTRUCT = frozenset({"numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct"})
_FROM_BUFFER = frozenset({"numpy.core.numeric._frombuffer", "numpy._core.numeric._frombuffer"})
_BYTES = frozenset({"_codecs.encode", "__builtin__.bytes", "builtins.bytes"})
_SCALAR = frozenset({"numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar"})


def read_array(value: Any) -> NDArray[Any]:
    """Return the array, number or list of numbers that a value describes."""
    if isinstance(value, bool | int | float | list | tuple):
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":
            raise NotPlainData("a list of something else than numbers")
        return array
    if not isinstance(value, Call):
        raise NotPlainData(f"{type(value).__name__} where an array is expected")
    name = str(value.function)
    if name in _RECONSTRUCT:
        _, shape, dtype, in_columns, content = value.state
        return _make_array(content, dtype, shape, "F" if in_columns else "C")
    if name in _FROM_BUFFER:
        content, dtype, shape, order = value.arguments
        return _make_array(content, dtype, shape, order)
    if name in _SCALAR:
        dtype, content = value.arguments
        return _make_array(content, dtype, (), "C")
    raise NotPlainData(f"{name} where an array is expected")


def _make_array(content: Any, dtype: Any, shape: Any, order: str) -> NDArray[Any]:
    if isinstance(content, Call) and str(content.function) in _BYTES:  # in the oldest protocols
        content = content.arguments[0] if content.arguments else ""
    if isinstance(content, str):
        content = content.encode("latin1")
    flat = np.frombuffer(content, read_dtype(dtype))
    return flat.reshape(shape, order="F" if order == "F" else "C").copy()


def read_dtype(value: Any) -> np.dtype[Any]:
    """Return the dtype of numbers that a value describes."""
    if isinstance(value, Name) and value.module == "numpy":
        text, byte_order = value.qualname.rstrip("_"), ""
    elif isinstance(value, Call) and str(value.function) == "numpy.dtype":
        text = str(value.arguments[0])
        byte_order = value.state[1] if value.state else ""
    else:
        raise NotPlainData(f"{value} where a dtype is expected")
    dtype = np.dtype(text)
    if dtype.kind not in "biuf":
        raise NotPlainData(f"an array of {text}")
    return dtype.newbyteorder(">") if byte_order == ">" else dtype


def read_plain(value: Any, depth: int = 0) -> Any:
    """Return numbers, text, lists and mappings as they are; raises `NotPlainData` for anything else."""
    if depth > _DEEPEST:
        raise NotPlainData("nested too deeply")
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list | tuple):
        return [read_plain(each, depth + 1) for each in value]
    if isinstance(value, Call) and str(value.function) == "collections.OrderedDict":
        value = value.items
    if isinstance(value, dict):
        return {str(key): read_plain(each, depth + 1) for key, each in value.items()}
    raise NotPlainData(f"{value if isinstance(value, Name) else getattr(value, 'function', type(value).__name__)}")
