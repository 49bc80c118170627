"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import ArtifactError
from rlctl.run import untrusted


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file beside its place, flush it to the disk, and rename it into place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with beside.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
    _sync_folder(path.parent)


def write_text(path: Path, content: str) -> None:
    """Write a UTF-8 file, whole or not at all."""
    write_bytes(path, content.encode())


def write_json(path: Path, content: Any) -> None:
    """Write indented JSON, whole or not at all."""
    write_text(path, json.dumps(content, indent=2) + "\n")


def read_json(path: Path) -> Any:
    """Read JSON; raises `ArtifactError` if the file is missing or damaged."""
    try:
        return untrusted.parse_json(untrusted.read_bytes(path, untrusted.JSON_LIMIT).decode())
    except ValueError as error:
        raise ArtifactError(f"{path}: damaged: {error}") from None


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as `.npz`, whole or not at all; object arrays, which would need pickle, are refused."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Read a `.npz` without pickle; raises `ArtifactError` if it is missing, damaged or of another kind."""
    try:
        return untrusted.read_arrays(path)
    except ArtifactError:
        raise
    except Exception as error:  # numpy raises whatever zipfile, zlib and its own parser raise
        raise ArtifactError(f"{path}: damaged, or not an .npz file: {error}") from None


@contextlib.contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Give a folder to fill; it takes its place when the block ends well, and is removed when it does not."""
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir(parents=True)
    try:
        yield beside
        for file in beside.iterdir():
            _sync(file)
        _sync(beside)
        if path.exists():
            shutil.rmtree(path)
        beside.replace(path)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    _sync_folder(path.parent)


def append_line(path: Path, line: str) -> None:
    """Append a line in one write."""
    with path.open("a", encoding="utf-8") as file:
        file.write(line + "\n")


def write_with(path: Path, write: Callable[[Path], None]) -> None:
    """Let `write` make a file under a temporary name in the same folder, then rename it into place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{os.getpid()}.part.{path.name}")  # keeps the suffix: some writers look at it
    try:
        write(beside)
        _sync(beside)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
    _sync_folder(path.parent)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_folder(path: Path) -> None:
    # Some file systems refuse to sync a folder; the rename itself has happened.
    with contextlib.suppress(OSError):
        _sync(path)
