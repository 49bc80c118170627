"""Files and folders that are written atomically."""

from __future__ import annotations

import contextlib
import errno
import glob
import hashlib
import io
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl.errors import ArtifactError
from rlctl.storage import untrusted

if TYPE_CHECKING:
    from numpy.typing import NDArray


@contextlib.contextmanager
def name_in_errors(path: Path) -> Iterator[None]:
    """Make an `OSError` name `path`; Python names no file, or a temporary one, if a write or a sync fails."""
    try:
        yield
    except OSError as error:
        if error.errno is not None:
            error.filename = str(path)
        raise


def write_with(path: Path, write: Callable[[Path], None]) -> None:
    """Let `write` create a temporary file next to `path`, sync it to disk, and rename it to `path`."""
    if not path.name:  # `/`, which has no folder for a temporary file
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    os.makedirs(path.parent, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}.part.{path.name}")  # the suffix stays: some writers depend on it
    try:
        with name_in_errors(path):
            write(temporary)
            sync(temporary)
            os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):  # the first error is the one to report
            os.unlink(temporary)
        raise
    _sync_folder(path.parent)


_ABANDONED_S = 60.0  # [s] without a change: on a shared disk the writer may be a process of another machine


def remove_abandoned(path: Path) -> None:
    """Remove temporary files of `write_with` for `path` whose process was killed: it could not."""
    for temporary in path.parent.glob(f".*.part.{glob.escape(path.name)}"):
        number = temporary.name[1:].partition(".")[0]
        with contextlib.suppress(OSError):  # removed by another process
            is_old = time.time() - temporary.stat().st_mtime > _ABANDONED_S
            if number.isdigit() and is_old and not _is_running(int(number)):
                os.unlink(temporary)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # of another user
        return True
    return True


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file, atomically."""
    write_with(path, lambda temporary: append(temporary, content, 0))


def write_new(path: Path, content: bytes) -> None:
    """Write a file and sync it to disk, not atomically: for files in a folder of `whole_folder`."""
    append(path, content, 0)
    sync(path)


def write_text(path: Path, content: str) -> None:
    """Write a UTF-8 file, atomically."""
    write_bytes(path, content.encode())


def write_result(path: Path, content: bytes) -> None:
    """Write a file that the user named: atomically, but directly into a device, a pipe, or `/dev/stdout`."""
    if path.is_relative_to("/dev") or (path.exists() and not path.is_file()):
        with name_in_errors(path), path.open("ab") as file:
            file.write(content)
    else:
        write_bytes(path.resolve() if path.is_symlink() else path, content)


def write_json(path: Path, content: Any) -> None:
    """Write indented JSON, atomically."""
    write_text(path, json.dumps(content, indent=2) + "\n")


def read_json(path: Path) -> Any:
    """Read JSON; raises `ArtifactError` if the file is missing or damaged."""
    try:
        return untrusted.parse_json(untrusted.read_bytes(path, untrusted.JSON_LIMIT).decode())
    except ValueError as error:
        raise ArtifactError(f"{path}: damaged: {error}") from None


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as `.npz`, atomically; raises `ValueError` for object arrays, which would need pickle."""
    import numpy as np

    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Read a `.npz` without pickle; raises `ArtifactError` if it is missing, damaged, too large or of another kind."""
    try:
        return untrusted.read_arrays(path)
    except ArtifactError:
        raise
    except Exception as error:  # of numpy, zipfile or zlib
        raise ArtifactError(f"{path}: damaged, or not an .npz file: {error}") from None


_OLD = ".old.part"


@contextlib.contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder to fill with `write_new`; at the end it is renamed to `path`, or removed on errors."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    remove_tree(temporary)
    try:
        with name_in_errors(path):
            os.makedirs(temporary)
            yield temporary
            sync(temporary)
            _take_place(temporary, path)
    except BaseException:
        remove_tree(temporary)
        raise
    _sync_folder(path.parent)


def _take_place(new: Path, path: Path) -> None:
    # Python has no system call that swaps folders; `recover` restores the old one after a crash.
    aside = path.with_name(f".{path.name}{_OLD}")
    if path.exists():
        os.rename(path, aside)
    try:
        os.rename(new, path)
    except OSError:
        if aside.exists():
            os.rename(aside, path)
        raise
    remove_tree(aside)


def recover(folder: Path) -> None:
    """Restore folders that a killed `whole_folder` had renamed, and remove incomplete files and folders."""
    for place in folder.glob(".*.part*"):
        original = folder / place.name[1:].removesuffix(_OLD)
        if place.name.endswith(_OLD) and not original.exists():
            os.rename(place, original)
        elif place.is_dir() and not place.is_symlink():
            remove_tree(place)
        else:
            remove(place)


def remove_tree(path: Path) -> None:
    """Remove a folder and its content, if it exists."""
    # Renamed first, so that a partly removed folder is never read.
    if not path.name.startswith("."):
        hidden = path.with_name(f".{path.name}.{os.getpid()}.part")
        shutil.rmtree(hidden, ignore_errors=True)
        with contextlib.suppress(FileNotFoundError):
            os.rename(path, hidden)
        path = hidden
    shutil.rmtree(path, ignore_errors=True)


def append(path: Path, content: bytes, size: int) -> None:
    """Truncate a file to `size` bytes and append `content`; truncate it again if the write fails."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        with name_in_errors(path):
            os.ftruncate(descriptor, size)
            _write_all(descriptor, content)
    except OSError:
        with contextlib.suppress(OSError):  # the next append truncates it again
            os.ftruncate(descriptor, size)
        raise
    finally:
        os.close(descriptor)


def truncate(path: Path, size: int) -> None:
    """Truncate a file to `size` bytes."""
    with name_in_errors(path), path.open("r+b") as file:
        file.truncate(size)
        os.fsync(file.fileno())


def _write_all(descriptor: int, content: bytes) -> None:
    rest = memoryview(content)
    while rest:
        written = os.write(descriptor, rest)
        if written == 0:
            raise OSError(errno.EIO, "the disk accepts no more data")
        rest = rest[written:]


def digest(content: bytes) -> str:
    """Return the sha256 of `content` in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def check_digest(path: Path, expected: str) -> None:
    """Raise `ArtifactError` if a file is missing or its sha256 is not `expected`."""
    if digest(untrusted.read_bytes(path)) != expected:
        raise ArtifactError(f"{path}: damaged: its content does not match its sha256")


_SEAL = "\n# sha256 of the above: "


def write_sealed(path: Path, content: str) -> None:
    """Write a UTF-8 file that ends in a comment with its sha256, atomically."""
    content = content.removesuffix("\n")
    write_text(path, f"{content}{_SEAL}{digest(content.encode())}\n")


def is_as_sealed(path: Path) -> bool:
    """Return whether a file is unchanged since `write_sealed` wrote it."""
    content, _, seal = path.read_bytes().rpartition(_SEAL.encode())
    return seal.decode(errors="replace") == digest(content) + "\n"


def set_aside(path: Path) -> None:
    """Rename a damaged file or folder to `NAME.damaged`, replacing an earlier one."""
    aside = path.with_name(f"{path.name}.damaged")
    if aside.is_dir():
        remove_tree(aside)
    os.replace(path, aside)


def remove(path: Path) -> None:
    """Remove a file, if it exists."""
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)


def sync(path: Path) -> None:
    """Flush a file or a folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        with name_in_errors(path):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_folder(path: Path) -> None:
    try:
        sync(path)
    except OSError as error:
        # Some file systems cannot sync a folder; the rename itself has happened.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EACCES, errno.EPERM):
            raise
