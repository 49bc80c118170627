"""Who may connect: loopback without a key, other machines with one, no pages of other sites."""

from __future__ import annotations

import hmac
import os
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from rlctl.errors import ArtifactError, UsageError
from rlctl.options import KEY_VARIABLE
from rlctl.storage import untrusted
from rlctl_robot.serve.serve_request import LOOPBACK

if TYPE_CHECKING:
    from aiohttp import web

_LONGEST_KEY = 4096  # [bytes]


def find_key(host: str, key_file: Path | None) -> str | None:
    """Return the key that clients must send, from a file or `RLCTL_API_KEY`; None: they need none.

    Raises `UsageError` for an address that other machines can reach without a key.
    """
    key = _read_key(key_file)
    if host not in LOOPBACK and key is None:
        raise UsageError(
            f"--host {host}: other machines can reach this server and could move the robot; set a key: "
            f"--key-file FILE, or {KEY_VARIABLE} in the environment"
        )
    return key


def _read_key(file: Path | None) -> str | None:
    if file is None:
        key = os.environ.get(KEY_VARIABLE)
        return key.strip() if key else None
    try:
        key = untrusted.read_bytes(file, _LONGEST_KEY).decode().strip()
    except UnicodeDecodeError:
        raise ArtifactError(f"{file}: not a key: it is no text") from None
    if not key or not key.isprintable() or not key.isascii():
        raise UsageError(f"--key-file {file}: the file contains no key; write the key as one line of ASCII text")
    return key


def is_websocket(request: web.BaseRequest) -> bool:
    """Return whether a request asks for a WebSocket."""
    return request.headers.get("Upgrade", "").lower() == "websocket"


def find_problem(request: web.BaseRequest, is_local: bool, key: str | None) -> tuple[int, str] | None:
    """Return the status and the text with which to refuse a request; None if it may be answered."""
    host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
    try:
        name, page_host = urlsplit(f"//{host}").hostname, urlsplit(origin or "").netloc
    except ValueError:  # `[::1`
        return 400, "Host or Origin is not an address"
    # Another site's domain can resolve to this machine (DNS rebinding); its pages could then send requests.
    if is_local and name not in LOOPBACK:
        return 403, "this server answers to localhost only"
    if origin is not None and page_host != host:
        return 403, "requests from other sites are refused"
    if key is None or request.path == "/healthz" or (request.path == "/" and not is_websocket(request)):
        return None
    if hmac.compare_digest(request.headers.get("Authorization", "").encode(), f"Api-Key {key}".encode()):
        return None
    return 401, "this server needs a key: Authorization: Api-Key KEY"
