"""Uploads files to an address with a manifest, and downloads them into a cache whose folders are named by SHA-256.

A pushed folder has a manifest, `rlctl.json`, with the size and SHA-256 of each file. Nothing is unpickled. Only file
types of rlctl are downloaded, and each file is checked before it enters the cache.
"""

import contextlib
import hashlib
import importlib
import os
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import pydantic

from rlctl.errors import ArtifactError, UsageError, describe_exception, short_repr
from rlctl.storage import files, untrusted

MANIFEST = "rlctl.json"
_ADDRESS = re.compile(r"^(?!wss?:)[a-z][a-z0-9+.-]+://.")
_DIGEST = re.compile("[0-9a-f]{64}")
_SUFFIXES = (".safetensors", ".onnx", ".json", ".yaml", ".csv", ".md", ".rrd")
_BUCKETS = {"s3", "s3a", "gs", "gcs", "az", "abfs", "hf"}
_MAX_FILES = 1000
_MAX_SIZE = 2 * 2**30  # [bytes] of one file
_CHUNK = 2**20  # [bytes]


class StoredFile(pydantic.BaseModel, extra="forbid"):
    """A file of a manifest."""

    size: int = pydantic.Field(ge=0, le=_MAX_SIZE)  # [bytes]
    sha256: str = pydantic.Field(pattern="^[0-9a-f]{64}$")


class Manifest(pydantic.BaseModel, extra="forbid"):
    """The files at an address, by their paths below it."""

    format: int = pydantic.Field(1, ge=1, le=1)
    files: dict[str, StoredFile] = pydantic.Field(max_length=_MAX_FILES)


def is_address(text: str | None) -> bool:
    """Return whether a text is an address of files, such as `s3://bucket/name`; `ws://` addresses a policy server."""
    return text is not None and _ADDRESS.match(text) is not None


def is_cached(path: Path) -> bool:
    """Return whether a file or folder was downloaded by `fetch`: others wrote what is in it."""
    return path.resolve().is_relative_to(_cache().resolve())


def fetch(address: str) -> Path:
    """Download the run or the file at an address, unless it is cached, and return its path in the cache.

    A file, or the manifest of a run, is checked against `#sha256=HEX` after the address. Raises `ArtifactError` if it
    is missing, incomplete or differs from its checksum, `UsageError` if the package for its scheme is not installed.
    """
    base, mark, expected = address.partition("#sha256=")
    if mark and not _DIGEST.fullmatch(expected := expected.lower()):  # it names a folder of the cache
        raise UsageError(f"{short_repr(address, 200)}: #sha256= takes 64 hexadecimal digits")
    with _open_store(base) as (store, path):
        if PurePosixPath(path).suffix in _SUFFIXES:
            return _fetch_file(store, path, base, expected)
        content = _read_manifest(store, path, base)
        folder = _cache() / _check_digest(base, hashlib.sha256(content).hexdigest(), expected)
        if not folder.exists():
            manifest = _parse_manifest(content, base)
            with _create_folder() as new:
                for name, entry in manifest.files.items():
                    target = new / name
                    target.parent.mkdir(parents=True, exist_ok=True)
                    _download(store, f"{path}/{name}", f"{base}/{name}", target, entry)
                _move_to_cache(new, folder)
        return folder


def push(contents: Mapping[str, Path | bytes], address: str) -> Manifest:
    """Upload files by their paths below an address, then their manifest; raises `ArtifactError` if that fails."""
    data = {name: untrusted.read_bytes(value) if isinstance(value, Path) else value for name, value in contents.items()}
    entries = {name: StoredFile(size=len(value), sha256=files.digest(value)) for name, value in data.items()}
    manifest = Manifest(files=entries)
    data[MANIFEST] = manifest.model_dump_json(indent=2).encode()
    with _open_store(address) as (store, path):
        protocols = (store.protocol,) if isinstance(store.protocol, str) else store.protocol
        for name, value in data.items():
            target = f"{path}/{name}"
            if not _BUCKETS.intersection(protocols):  # there makedirs would create a bucket
                store.makedirs(target.rpartition("/")[0], exist_ok=True)
            store.pipe_file(target, value)
    return manifest


@contextlib.contextmanager
def _open_store(address: str) -> Iterator[tuple[Any, str]]:
    scheme = address.partition("://")[0]
    try:
        store, path = importlib.import_module("fsspec").core.url_to_fs(address)
    except ImportError as error:
        raise UsageError(f"{address}: {scheme}:// needs packages: pip install 'rlctl[hub]' ({error})") from None
    except ValueError as error:
        raise UsageError(f"{address}: {short_repr(str(error), 200)}") from None
    try:
        yield store, str(path).rstrip("/")
    except ArtifactError:
        raise
    except FileNotFoundError:
        raise ArtifactError(f"{address}: nothing exists at this address, or reading it is not permitted") from None
    except Exception as error:  # each file system has its own exceptions
        raise ArtifactError(f"{address}: {short_repr(describe_exception(error), 300)}") from None


def _read_manifest(store: Any, path: str, address: str) -> bytes:
    try:
        with store.open(f"{path}/{MANIFEST}", "rb") as stream:
            return bytes(stream.read(untrusted.JSON_LIMIT))
    except FileNotFoundError:
        raise ArtifactError(
            f"{address}: no {MANIFEST} there; give an address that rlctl push wrote to, or a .safetensors or .onnx file"
        ) from None


def _parse_manifest(content: bytes, address: str) -> Manifest:
    try:
        manifest = Manifest.model_validate_json(content)
    except pydantic.ValidationError as error:
        raise ArtifactError(f"{address}/{MANIFEST}: not a manifest of rlctl: {error.errors()[0]['msg']}") from None
    for name in manifest.files:
        parts = PurePosixPath(name).parts
        is_plain = bool(parts) and "/".join(parts) == name and ".." not in parts and not name.startswith("/")
        if not is_plain or "\\" in name or not name.isprintable() or PurePosixPath(name).suffix not in _SUFFIXES:
            raise ArtifactError(
                f"{address}/{MANIFEST}: it lists {short_repr(name)}, a name or file type that rlctl does not download"
            )
    return manifest


def _fetch_file(store: Any, path: str, address: str, expected: str) -> Path:
    name = PurePosixPath(path).name
    if expected and (cached := _cache() / expected / name).is_file():
        return cached
    with _create_folder() as new:
        folder = _cache() / _check_digest(address, _download(store, path, address, new / name, None), expected)
        if not folder.exists():
            _move_to_cache(new, folder)
    return folder / name


def _check_digest(address: str, sha256: str, expected: str) -> str:
    if expected and sha256 != expected:
        raise ArtifactError(f"{address}: its SHA-256 is {sha256}, not {short_repr(expected, 80)}")
    return sha256


def _download(store: Any, path: str, address: str, target: Path, entry: StoredFile | None) -> str:
    """Download a file and return its SHA-256; raises `ArtifactError` if it differs from its manifest entry."""
    largest, size, digest = (_MAX_SIZE if entry is None else entry.size), 0, hashlib.sha256()
    with store.open(path, "rb") as stream, target.open("wb") as file:
        while size <= largest and (chunk := stream.read(_CHUNK)):
            size += len(chunk)
            digest.update(chunk)
            file.write(chunk)
    if entry is not None and size < entry.size:
        raise ArtifactError(f"{address}: truncated: {size:,} of {entry.size:,} bytes")
    if size > largest:
        raise ArtifactError(f"{address}: larger than {largest:,} bytes")
    if entry is not None and digest.hexdigest() != entry.sha256:
        raise ArtifactError(f"{address}: its SHA-256 differs from {MANIFEST}: the file was changed after the push")
    return digest.hexdigest()


def _cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "rlctl" / "hub"


@contextlib.contextmanager
def _create_folder() -> Iterator[Path]:
    _cache().mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="new-", dir=_cache(), ignore_cleanup_errors=True) as folder:
        yield Path(folder)


def _move_to_cache(new: Path, folder: Path) -> None:
    try:
        new.rename(folder)
    except OSError:
        if not folder.is_dir():  # it is one if another process has downloaded the same
            raise
