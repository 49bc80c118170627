"""Reads the tensors of a file of `torch.save` without unpickling it."""

import dataclasses
import io
import math
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from rlctl.importing import pickle_data
from rlctl.importing.pickle_data import Call, NotPlainData, Persistent

LARGEST_MEMBER = 500_000_000  # limit of the unpacked size of a member of the archive [bytes]

_STORAGES = {
    "DoubleStorage": "f8", "FloatStorage": "f4", "HalfStorage": "f2", "LongStorage": "i8", "IntStorage": "i4",
    "ShortStorage": "i2", "CharStorage": "i1", "ByteStorage": "u1", "BoolStorage": "?",
}  # fmt: skip
_MOST_DEEP = 20  # modules in modules
_MAGIC_NUMBER = 0x1950A86A20F9469CFC6C  # begins a file of torch before 1.6


@dataclasses.dataclass(frozen=True)
class _Tensor:
    """Where the numbers of a tensor are: its storage, and its place in it, in numbers."""

    storage: str
    dtype: np.dtype[Any]
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


def read_member(archive: zipfile.ZipFile, name: str) -> bytes:
    """Return a member of an archive; raises `NotPlainData` if it is missing or too large."""
    try:
        member = archive.getinfo(name)
    except KeyError:
        raise NotPlainData(f"no file {name!r} in the archive; it has {', '.join(archive.namelist()[:8])}") from None
    if member.file_size > LARGEST_MEMBER:
        raise NotPlainData(f"{name!r} has {member.file_size:,} bytes; the limit is {LARGEST_MEMBER:,}")
    with archive.open(member) as stream:
        return stream.read(member.file_size)


def read_tensors(content: bytes) -> dict[str, NDArray[Any]]:
    """Return the tensors, by name, of a state dict that `torch.save` wrote, as a zip archive or as before torch 1.6.

    Raises `NotPlainData` for damaged content, and for tensors that are too large or read outside their storage.
    """
    stream = io.BytesIO(content)
    if not zipfile.is_zipfile(stream):
        return _read_stream(stream)
    with zipfile.ZipFile(stream) as archive:
        prefix = next((name[: -len("data.pkl")] for name in archive.namelist() if name.endswith("/data.pkl")), "")
        if f"{prefix}byteorder" in archive.namelist() and read_member(archive, f"{prefix}byteorder") != b"little":
            raise NotPlainData("tensors of a big-endian machine")
        state = _describe_tensors(pickle_data.read(read_member(archive, f"{prefix}data.pkl")))
        return _read_all(state, lambda storage: read_member(archive, f"{prefix}data/{storage}"))


@dataclasses.dataclass(frozen=True)
class Module:
    """A module of a TorchScript archive: its class, tensors and other values by name, the modules in it, its code."""

    name: str
    tensors: dict[str, NDArray[Any]]
    values: dict[str, Any]
    modules: dict[str, "Module"]
    code: str
    """Of all classes in the file of its class; nothing of it is executed."""


def read_torchscript(content: bytes) -> Module:
    """Return the module that `torch.jit.save` wrote, as data.

    Raises `NotPlainData` for other content, and for tensors that are too large or read outside their storage.
    """
    stream = io.BytesIO(content)
    if not zipfile.is_zipfile(stream):
        raise NotPlainData("not an archive of TorchScript")
    with zipfile.ZipFile(stream) as archive:
        prefix = next((name[: -len("data.pkl")] for name in archive.namelist() if name.endswith("/data.pkl")), "")
        if not any(name.startswith(f"{prefix}code/") for name in archive.namelist()):
            raise NotPlainData("weights without a network: it was written by torch.save, not by torch.jit.save")
        if f"{prefix}byteorder" in archive.namelist() and read_member(archive, f"{prefix}byteorder") != b"little":
            raise NotPlainData("tensors of a big-endian machine")
        described = pickle_data.read(read_member(archive, f"{prefix}data.pkl"))
        return _read_module(archive, prefix, described, _MOST_DEEP)


def _read_module(archive: zipfile.ZipFile, prefix: str, described: Any, depth: int) -> Module:
    if not isinstance(described, Call) or not isinstance(described.state, dict) or not depth:
        raise NotPlainData("something other than a module of torch")
    tensors: dict[str, _Tensor] = {}
    values: dict[str, Any] = {}
    modules: dict[str, Module] = {}
    for name, value in described.state.items():
        if isinstance(value, Call) and str(value.function).startswith("__torch__."):
            modules[str(name)] = _read_module(archive, prefix, value, depth - 1)
        elif isinstance(value, Call) and str(value.function).startswith("torch._utils."):
            tensors[str(name)] = _describe_tensor(value)
        else:
            values[str(name)] = value
    arrays = _read_all(tensors, lambda storage: read_member(archive, f"{prefix}data/{storage}"))
    file = f"{prefix}code/{described.function.module.replace('.', '/')}.py"
    code = ""
    if file in archive.namelist():
        code = read_member(archive, file).decode(errors="replace")
    return Module(str(described.function), arrays, values, modules, code)


def _read_stream(stream: io.BytesIO) -> dict[str, NDArray[Any]]:
    """Read the older form: five pickles, then of each storage the count of its numbers, as int64, and its content."""
    stream.seek(0)
    magic, _, system, values, storages = (pickle_data.read(stream) for _ in range(5))
    if magic != _MAGIC_NUMBER or not system["little_endian"]:
        raise NotPlainData("tensors of a big-endian machine, or in a form that torch.save does not write")
    state = _describe_tensors(values)
    types = {tensor.storage: tensor.dtype for tensor in state.values()}
    contents = {}
    for storage in storages:
        size = int.from_bytes(stream.read(8), "little") * types[storage].itemsize
        contents[storage] = stream.read(min(size, LARGEST_MEMBER))
        if len(contents[storage]) != size:
            raise NotPlainData("a storage that ends early")
    return _read_all(state, lambda storage: contents[storage])


def _describe_tensors(state: Any) -> dict[str, _Tensor]:
    return {
        str(name): _describe_tensor(value)
        for name, value in dict(state.items if isinstance(state, Call) else state).items()
    }


def _describe_tensor(value: Any) -> _Tensor:
    if isinstance(value, Call) and str(value.function) == "torch._utils._rebuild_parameter":
        value = value.arguments[0]
    if not isinstance(value, Call) or str(value.function) != "torch._utils._rebuild_tensor_v2":
        raise NotPlainData(f"{getattr(value, 'function', type(value).__name__)} where a tensor is expected")
    storage, offset, shape, strides = value.arguments[:4]
    if not isinstance(storage, Persistent):
        raise NotPlainData("a tensor without storage")
    _, kind, key, *_ = storage.content
    return _Tensor(str(key), np.dtype(_STORAGES[kind.qualname]), offset, shape, strides)


def _read_all(state: dict[str, _Tensor], read_storage: Callable[[str], bytes]) -> dict[str, NDArray[Any]]:
    tensors: dict[str, NDArray[Any]] = {}
    size = 0
    for name, tensor in state.items():
        tensors[name] = _read_tensor(tensor, np.frombuffer(read_storage(tensor.storage), tensor.dtype))
        size += tensors[name].nbytes
        if size > LARGEST_MEMBER:  # many names may share one storage
            raise NotPlainData(f"tensors of more than {LARGEST_MEMBER:,} bytes")
    return tensors


def _read_tensor(tensor: _Tensor, numbers: NDArray[Any]) -> NDArray[Any]:
    offset, shape, strides = tensor.offset, tensor.shape, tensor.strides
    last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    if min((offset, *shape, *strides), default=0) < 0 or (0 not in shape and last >= numbers.size):
        raise NotPlainData("a tensor that reads outside its storage")
    if 0 in shape:
        return np.zeros(shape, tensor.dtype)
    if math.prod(shape) > numbers.size:  # strides of 0 would repeat numbers
        raise NotPlainData("a tensor larger than its storage")
    return as_strided(numbers[offset:], shape, [stride * tensor.dtype.itemsize for stride in strides]).copy()
