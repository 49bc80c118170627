"""Reads a pickle as data: nothing in it is imported or called.

A pickle is a program for a stack machine. This machine has the same stack and memory, but where the program imports or
calls something, the value is a description of that import or call.
"""

import dataclasses
import pickletools
from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

MOST_OPCODES = 2_000_000
_MOST_VALUES = 10_000_000
"""Values of a pickle, one that it mentions several times counted each time: what walks through them takes as long."""
_MOST_ARGUMENTS = 1000  # of a call; each call with keywords copies them
_KEYS = (str, bytes, int, float, type(None))


class NotPlainData(ValueError):
    """A pickle is damaged, or has data of a kind that is not supported."""


@dataclasses.dataclass(frozen=True)
class Name:
    """A class or function that a pickle refers to."""

    module: str
    qualname: str

    def __str__(self) -> str:
        return f"{self.module}.{self.qualname}"


@dataclasses.dataclass(eq=False)
class Call:
    """The call of a name, the state that the pickle sets on its result, and the items that it puts into it."""

    function: Name
    arguments: tuple[Any, ...]
    state: Any = None
    items: dict[Any, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Persistent:
    """A reference to data outside the pickle, such as the storage of a tensor."""

    content: Any


_MARK = object()


def _make_call(function: Any, arguments: Any, keywords: Any = None) -> Call:
    if not isinstance(function, Name) or not isinstance(arguments, tuple):
        raise NotPlainData("a call of something other than a name")
    if len(arguments) > _MOST_ARGUMENTS:
        raise NotPlainData(f"a call with {len(arguments):,} arguments")
    return Call(function, arguments if keywords is None else (*arguments, keywords))


def _set_state(target: Any, state: Any) -> Any:
    if not isinstance(target, Call):
        raise NotPlainData("a state for something other than the result of a call")
    target.state = state
    return target


def _make_name(module: Any, qualname: Any) -> Name:
    if not isinstance(module, str) or not isinstance(qualname, str):
        raise NotPlainData("a name that is not text")
    return Name(module, qualname)


def _pair(items: list[Any]) -> dict[Any, Any]:
    return dict(zip(_check_keys(items[::2]), items[1::2], strict=True))


def _check_keys(keys: list[Any]) -> list[Any]:
    """Refuse keys whose hash is computed from other values: tuples of tuples of tuples would take forever."""
    for key in keys:
        if not isinstance(key, (*_KEYS, Name)):
            raise NotPlainData(f"a {type(key).__name__} as a key")
    return keys


def _set_items(target: Any, items: list[Any]) -> None:
    (target.items if isinstance(target, Call) else target).update(_pair(items))


_PUSHES_ARGUMENT = frozenset(
    {
        *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
        *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"),
        *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
    }
)
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "MARK": _MARK}
_EMPTY: dict[str, Callable[[], Any]] = {"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_SET": set, "EMPTY_TUPLE": tuple}
_MAKES: dict[str, tuple[int, Callable[..., Any]]] = {
    "TUPLE1": (1, lambda *values: values),
    "TUPLE2": (2, lambda *values: values),
    "TUPLE3": (3, lambda *values: values),
    "STACK_GLOBAL": (2, _make_name),
    "REDUCE": (2, _make_call),
    "NEWOBJ": (2, _make_call),
    "NEWOBJ_EX": (3, _make_call),
    "BUILD": (2, _set_state),
    "BINPERSID": (1, Persistent),
}
"""Instruction -> the number of values that it pops, and the function that makes one value of them."""
_COLLECTS: dict[str, Callable[[list[Any]], Any]] = {
    "TUPLE": tuple, "LIST": list, "FROZENSET": lambda items: frozenset(_check_keys(items)), "DICT": _pair,
}  # fmt: skip
"""Instruction -> the function that makes one value of the values above the mark."""
_ADDS: dict[str, tuple[int | None, Callable[[Any, list[Any]], None]]] = {
    "APPEND": (1, lambda target, items: target.extend(items)),
    "APPENDS": (None, lambda target, items: target.extend(items)),
    "ADDITEMS": (None, lambda target, items: target.update(_check_keys(items))),
    "SETITEM": (2, _set_items),
    "SETITEMS": (None, _set_items),
}
"""Instruction -> the number of values that it pops, None for those above the mark, and the function that adds them."""
_IGNORED = frozenset({"PROTO", "FRAME", "READONLY_BUFFER"})


def read(content: bytes | BinaryIO) -> Any:
    """Return the value that a pickle describes, of plain types, `Name`, `Call` and `Persistent`.

    A stream is read to the end of the pickle.
    Raises `NotPlainData` for a damaged pickle, and for instructions that model files do not have.
    """
    machine = _Machine()
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
            if count > MOST_OPCODES:
                raise NotPlainData(f"more than {MOST_OPCODES:,} instructions")
            if opcode.name == "STOP":
                return _check_size(machine.stack.pop())
            machine.run(opcode.name, argument)
    except NotPlainData:
        raise
    except (IndexError, KeyError, TypeError, AttributeError, ValueError):
        raise NotPlainData("its pickle is damaged") from None
    raise NotPlainData("its pickle has no end")


def _check_size(value: Any) -> Any:
    """Return a value that has at most `_MOST_VALUES`; one that it mentions twice counts twice."""
    sizes: dict[int, int] = {}
    waiting = [(value, False)]
    while waiting:
        current, parts_are_counted = waiting.pop()
        parts = _list_parts(current)
        if parts_are_counted:
            sizes[id(current)] = 1 + sum(sizes[id(part)] for part in parts)
            if sizes[id(current)] > _MOST_VALUES:
                raise NotPlainData(f"more than {_MOST_VALUES:,} values, or one that contains itself")
        elif id(current) not in sizes:
            sizes[id(current)] = _MOST_VALUES  # until its parts are counted: one that contains itself has no size
            waiting.append((current, True))
            waiting.extend((part, False) for part in parts)
    return value


def _list_parts(value: Any) -> list[Any]:
    if isinstance(value, list | tuple):
        return list(value)
    if isinstance(value, dict):
        return list(value.values())
    if isinstance(value, Call):
        return [value.arguments, value.state, value.items]
    if isinstance(value, Persistent):
        return [value.content]
    return []


class _Machine:
    def __init__(self) -> None:
        self.stack: list[Any] = []
        self._memory: dict[int, Any] = {}

    def run(self, name: str, argument: Any) -> None:
        stack, memory = self.stack, self._memory
        if name in _PUSHES_ARGUMENT:
            stack.append(argument)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name in _EMPTY:
            stack.append(_EMPTY[name]())
        elif name in _MAKES:
            count, make = _MAKES[name]
            stack.append(make(*self._pop(count)))
        elif name in _COLLECTS:
            stack.append(_COLLECTS[name](self._pop_to_mark()))
        elif name in _ADDS:
            size, add = _ADDS[name]
            items = self._pop_to_mark() if size is None else self._pop(size)
            add(stack[-1], items)
        elif name in ("MEMOIZE", "PUT", "BINPUT", "LONG_BINPUT"):
            memory[len(memory) if argument is None else int(argument)] = stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(memory[int(argument)])
        elif name == "GLOBAL":
            stack.append(Name(*argument.split(" ", 1)))
        elif name == "DUP":
            stack.append(stack[-1])
        elif name == "POP":
            stack.pop()
        elif name == "POP_MARK":
            self._pop_to_mark()
        elif name not in _IGNORED:
            raise NotPlainData(f"the pickle instruction {name}, which model files do not have")

    def _pop(self, count: int) -> list[Any]:
        return [self.stack.pop() for _ in range(count)][::-1]

    def _pop_to_mark(self) -> list[Any]:
        items = []
        while (value := self.stack.pop()) is not _MARK:
            items.append(value)
        return items[::-1]


_BYTES = ("_codecs.encode", "__builtin__.bytes", "builtins.bytes")


def read_array(value: Any) -> NDArray[Any]:
    """Return the array, number or list of numbers that a value describes."""
    if isinstance(value, bool | int | float | list | tuple):
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":
            raise NotPlainData("a list of something other than numbers")
        return array
    if not isinstance(value, Call):
        raise NotPlainData(f"{type(value).__name__} where an array is expected")
    name = str(value.function).replace("numpy._core.", "numpy.core.")  # the name before NumPy 2
    if name == "numpy.core.multiarray._reconstruct":
        _, shape, dtype, in_columns, content = value.state
        return _make_array(content, dtype, shape, "F" if in_columns else "C")
    if name == "numpy.core.numeric._frombuffer":
        content, dtype, shape, order = value.arguments
        return _make_array(content, dtype, shape, order)
    if name == "numpy.core.multiarray.scalar":
        dtype, content = value.arguments
        return _make_array(content, dtype, (), "C")
    raise NotPlainData(f"{name} where an array is expected")


def _make_array(content: Any, dtype: Any, shape: Any, order: str) -> NDArray[Any]:
    if isinstance(content, Call) and str(content.function) in _BYTES:  # in pickle protocols 0 to 2
        content = content.arguments[0] if content.arguments else ""
    if isinstance(content, str):
        content = content.encode("latin1")
    return np.frombuffer(content, read_dtype(dtype)).reshape(shape, order="F" if order == "F" else "C").copy()


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


def read_plain(value: Any) -> Any:
    """Return numbers, text, lists and mappings; raises `NotPlainData` for anything else."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list | tuple):
        return [read_plain(item) for item in value]
    if isinstance(value, Call) and str(value.function) == "collections.OrderedDict":
        value = value.items
    if isinstance(value, dict):
        return {str(key): read_plain(item) for key, item in value.items()}
    raise NotPlainData(f"{value if isinstance(value, Name) else getattr(value, 'function', type(value).__name__)}")
