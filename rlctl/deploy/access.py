"""Who may talk to a server: by a key, and never a page of another site in somebody's browser."""

from __future__ import annotations

import hmac
from collections.abc import Awaitable, Callable
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.typedefs import Middleware

from rlctl.deploy.serve import LOOPBACK

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def make_access_check(host: str, key: str | None, on_refused: Callable[[], None]) -> Middleware:
    """Return what refuses requests without the key (`Authorization: Api-Key KEY`), and those of other sites' pages."""

    @web.middleware
    async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
        if (problem := _find_problem(request, host in LOOPBACK, key)) is None:
            return await handler(request)
        on_refused()
        return web.Response(status=problem[0], text=f"{problem[1]}\n")

    return check


def _find_problem(request: web.Request, is_local: bool, key: str | None) -> tuple[int, str] | None:
    host = request.headers.get("Host", "")
    # A name that somebody lets point to this machine would open it to the pages of that name.
    if is_local and urlsplit(f"//{host}").hostname not in LOOPBACK:
        return 403, "this server answers to localhost only"
    origin = request.headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != host:
        return 403, "requests of other sites are refused"
    page = request.path == "/" and request.headers.get("Upgrade", "").lower() != "websocket"
    if key is None or request.path == "/healthz" or page:
        return None
    if hmac.compare_digest(request.headers.get("Authorization", "").encode(), f"Api-Key {key}".encode()):
        return None
    return 401, "this server needs a key: Authorization: Api-Key KEY"
