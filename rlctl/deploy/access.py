"""Who may talk to a server: by a key, and never a page of another site in somebody's browser."""

from __future__ import annotations

import hmac
from collections.abc import Awaitable, Callable
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.typedefs import Middleware

from rlctl.deploy.serve import LOOPBACK

_OPEN = ("/healthz",)

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Access:
    """Refuses requests without the key (`Authorization: Api-Key KEY`), and those that a browser sends for others."""

    def __init__(self, host: str, key: str | None, on_refused: Callable[[], None]) -> None:
        self._key = key
        self._is_local = host in LOOPBACK
        self._on_refused = on_refused

    @property
    def check(self) -> Middleware:
        """The middleware."""

        @web.middleware
        async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
            if (problem := self._find_problem(request)) is not None:
                self._on_refused()
                return web.Response(status=problem[0], text=f"{problem[1]}\n")
            return await handler(request)

        return check

    def _find_problem(self, request: web.Request) -> tuple[int, str] | None:
        host = request.headers.get("Host", "")
        # A name that somebody lets point to this machine would open it to the pages of that name.
        if self._is_local and urlsplit(f"//{host}").hostname not in LOOPBACK:
            return 403, "this server answers to localhost only"
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return 403, "requests of other sites are refused"
        page = request.path == "/" and request.headers.get("Upgrade", "").lower() != "websocket"
        if self._key is None or request.path in _OPEN or page:
            return None
        given = request.headers.get("Authorization", "")
        if hmac.compare_digest(given.encode(), f"Api-Key {self._key}".encode()):
            return None
        return 401, "this server needs a key: Authorization: Api-Key KEY"
