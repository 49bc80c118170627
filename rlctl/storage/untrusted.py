"""Reads files that others may have sent: regular files only, nothing is unpickled, and memory is limited."""

from __future__ import annotations

import contextlib
import json
import lzma
import os
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

from rich.filesize import decimal as format_bytes

from rlctl.errors import ArtifactError, short_repr
from rlctl.version import __version__

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pydantic import BaseModel

Model = TypeVar("Model", bound="BaseModel")

_CGROUPS = Path("/sys/fs/cgroup")
JSON_LIMIT = 16 * 2**20  # [bytes]
_DEEPEST = 100  # levels of JSON; writing or printing more may exceed a recursion limit
_LFS_POINTER = b"version https://git-lfs.github.com/spec/"
_ALWAYS_READ = 1_000_000  # [bytes]
ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, RuntimeError, OSError, ValueError)
"""What reading a damaged archive raises; `RuntimeError` for one that is encrypted or packed in an unknown way."""
_MEMBERS = 1000  # maximum number of arrays in a file
_PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Allowed compressions: those of numpy. With LZMA the file itself would decide how much memory unpacking takes."""


@contextlib.contextmanager
def open_file(path: Path) -> Iterator[BinaryIO]:
    """Open a regular file; raises `ArtifactError` for one that is missing, unreadable, a folder, a pipe or a device."""
    try:
        # O_NONBLOCK: opening a pipe would otherwise wait for a writer.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        raise ArtifactError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise ArtifactError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if not stat.S_ISREG(mode := os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ArtifactError(f"{path}: {'a folder' if stat.S_ISDIR(mode) else 'a pipe or a device'}, not a file")
    with os.fdopen(descriptor, "rb") as file:
        yield file


def read_bytes(path: Path, limit: int | None = None) -> bytes:
    """Read a regular file of at most `limit` bytes, or by default what fits into memory; raises `ArtifactError`."""
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if limit is not None and size > limit:
            raise ArtifactError(f"{path}: too large: {format_bytes(size)}, the limit is {format_bytes(limit)}")
        check_size(path, size)
        try:
            content = file.read()
        except OSError as error:
            raise ArtifactError(f"{path}: cannot be read: {error.strerror or error}") from None
    _check_content(path, content)
    return content


def _check_content(path: Path, content: bytes) -> None:
    """Raise `ArtifactError` for the text that Git LFS leaves in place of a file."""
    if content.startswith(_LFS_POINTER):
        raise ArtifactError(f"{path}: a pointer of Git LFS, not the file itself: git lfs pull")


def check_size(path: Path, size: int, what: str = "") -> None:
    """Raise `ArtifactError` if `size` bytes are more than half of the available memory."""
    # Measuring memory costs as much as reading a small file, and `rlctl runs` reads thousands of them.
    if size > _ALWAYS_READ and (free := measure_free_memory()) is not None and size > free // 2:
        needs = f"{what}it needs {format_bytes(size)} of memory, and {format_bytes(free)} are free"
        raise ArtifactError(f"{path}: too large: {needs}")


def check_safetensors(path: Path) -> None:
    """Raise `ArtifactError` for a policy file that is not a regular file, or too large for the memory."""
    with open_file(path) as file:
        check_size(path, os.fstat(file.fileno()).st_size)
        _check_content(path, file.read(len(_LFS_POINTER)))


def parse_json(text: str | bytes) -> Any:
    """Parse JSON; raises `ValueError` if it is damaged, nested too deeply, or contains a number that is too large."""
    try:
        content = json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    level = [content]
    for _ in range(_DEEPEST):
        parts = [part.values() if isinstance(part, dict) else part for part in level if isinstance(part, dict | list)]
        level = [value for part in parts for value in part]
        if not level:
            return content
    raise ValueError("nested too deeply")


def parse_model(text: str | bytes, model: type[Model], path: Path, what: str) -> Model:
    """Parse JSON as a model that has a field `format`; raises `ArtifactError` if damaged or newer than this rlctl."""
    newest = model.model_fields["format"].default
    content = None
    try:
        content = parse_json(text)
        json.dumps(content, ensure_ascii=False).encode()  # half a surrogate pair is no text: nothing could write it
        file_format = content.get("format") if isinstance(content, dict) else None
        if isinstance(file_format, int) and file_format > newest:
            known = f"this rlctl {__version__} can read ({newest}); upgrade rlctl"
            raise ArtifactError(f"{path}: {what} format {file_format} is newer than {known}")
        return model.model_validate(content)
    except ValueError as error:
        import pydantic

        from rlctl.storage import validation

        explained = isinstance(error, pydantic.ValidationError) and validation.explain_invalid(error, model, content)
        raise ArtifactError(f"{path}: damaged: {short_repr(explained or str(error), 200)}") from None


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of an `.npz` file by name, after a check of the sizes that the archive declares.

    Raises `ArtifactError` for a file that is missing or too large, and any exception of numpy or zipfile for a damaged
    one. An array's own header may declare a larger size: numpy then fails, and it touches no memory before it reads.
    """
    import numpy as np

    with open_file(path) as file, zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        if len(members) > _MEMBERS:
            raise ValueError(f"it has {len(members):,} members, the limit is {_MEMBERS:,}")
        for member in members:
            if not member.filename.endswith(".npy") or member.compress_type not in _PACKED:
                raise ValueError(f"{member.filename!r} is not an array, or its compression is not numpy's")
        check_size(path, sum(member.file_size for member in members), "unpacked ")
        arrays: dict[str, NDArray[Any]] = dict(np.load(path, allow_pickle=False))
    for name, content in arrays.items():
        if not isinstance(content, np.ndarray):  # without a header numpy returns bytes
            raise ValueError(f"{name!r} is not an array")
    return arrays


def measure_free_memory() -> int | None:
    """Return how many bytes this process can still use, by machine and control groups; None if unknown.

    NumPy and torch reserve memory without touching it: an allocation that is too large succeeds, and the system kills
    the process later.
    """
    limits = [value for value in (_read_machine(), *_read_control_groups()) if value is not None]
    return max(min(limits), 0) if limits else None


def _read_machine() -> int | None:
    with contextlib.suppress(OSError, StopIteration, ValueError):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    with contextlib.suppress(OSError, ValueError):  # not Linux: only the installed memory is known
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def _read_control_groups() -> list[int]:
    """Return the memory left in each control group (container, job); a group's limit includes its subgroups."""
    try:
        entries = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return []
    own = next((entry[3:] for entry in entries if entry.startswith("0::")), "/")
    folder = _CGROUPS / own.strip("/")
    groups = [group for group in (folder, *folder.parents) if group.is_relative_to(_CGROUPS)]
    limits = [_read_group(group, "memory.max", "memory.current", "file") for group in groups]
    limits.append(_read_group(_CGROUPS / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "cache"))
    return [value for value in limits if value is not None]


def _read_group(group: Path, limit: str, used: str, cache_name: str) -> int | None:
    try:
        ceiling = int((group / limit).read_text(encoding="ascii"))  # "max" without a limit
        taken = int((group / used).read_text(encoding="ascii"))
        rows = (group / "memory.stat").read_text(encoding="ascii").splitlines()
    except (OSError, ValueError):
        return None
    # The system counts cached files as used, but frees them when memory is short.
    cached = next((int(row.split()[1]) for row in rows if row.startswith(f"{cache_name} ")), 0)
    return ceiling - taken + cached
