"""Limits of a server's connections: how many may be open, and how long each may wait for a request."""

import asyncio
import os
import resource
import time
from collections.abc import Awaitable, Callable

from aiohttp import web

from rlctl.errors import UsageError

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
_Handler = web.RequestHandler
_Times = dict[_Handler, float]

BACKLOG = 64  # connections that the kernel accepts before the loop sees them
_FIRST_REQUEST_S = 10.0
_NEXT_REQUEST_S = 75.0
_RESERVED_FILES = 32  # file descriptors for files, policies and logs
_HTTP_CONNECTIONS = 16  # connections for HTTP requests


def count_allowed_connections(max_clients: int) -> int:
    """Return how many connections may be open, so that the server can always accept a stop request.

    Raises `UsageError` if this process may open too few files for `max_clients`.
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = limit - len(os.listdir("/proc/self/fd" if os.path.isdir("/proc/self/fd") else "/dev/fd"))
    allowed -= BACKLOG + _RESERVED_FILES
    if allowed < max_clients + _HTTP_CONNECTIONS:
        needed = limit + max_clients + _HTTP_CONNECTIONS - allowed
        raise UsageError(
            f"--max-clients {max_clients}: this process may open {limit} files, which is too few; "
            f"raise the limit, ulimit -n {needed}, or allow fewer clients"
        )
    return allowed


class Connections:
    """The connections of a server, oldest first.

    A connection that sends no complete request header in time is closed. If too many are open, the server closes the
    one that has waited longest, then the one whose request has taken longest, but never a WebSocket client.
    """

    def __init__(self, allowed: int) -> None:
        self._allowed = allowed
        self._waiting: _Times = {}  # time.monotonic() at which it is closed
        self._answering: _Times = {}
        self._clients: _Times = {}

    def accept(self, handler: _Handler) -> _Handler:
        """Register a new connection, and close an old one if too many are open."""
        self._waiting[handler] = time.monotonic() + _FIRST_REQUEST_S
        if self._count() > self._allowed:
            self._forget_closed()
            for handler_to_close in [*self._waiting, *self._answering][: max(0, self._count() - self._allowed)]:
                self._close(handler_to_close)
        return handler

    @web.middleware
    async def follow(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Answer a request, and count its connection as active until then. A middleware of aiohttp."""
        connection = request.protocol
        is_client = request.headers.get("Upgrade", "").lower() == "websocket"
        group = self._clients if is_client else self._answering
        self._waiting.pop(connection, None)
        group[connection] = time.monotonic()
        try:
            return await handler(request)
        except (ConnectionError, web.RequestPayloadError, RuntimeError):
            if connection.transport is not None:
                raise
            return web.Response(status=400)  # the client disconnected during its request; nobody receives this answer
        finally:
            group.pop(connection, None)
            if connection.transport is not None:
                self._waiting[connection] = time.monotonic() + _NEXT_REQUEST_S

    async def close_slow(self) -> None:
        """Close connections that have waited too long; runs until cancelled."""
        while True:
            await asyncio.sleep(1.0)
            self._forget_closed()
            now = time.monotonic()
            for handler in [handler for handler, until in self._waiting.items() if until < now]:
                self._close(handler)

    def _count(self) -> int:
        return len(self._waiting) + len(self._answering) + len(self._clients)

    def _forget_closed(self) -> None:
        oldest = time.monotonic() + _FIRST_REQUEST_S - 1.0  # newer ones may not be connected yet
        closed = [handler for handler, until in self._waiting.items() if handler.transport is None and until < oldest]
        for handler in closed:
            del self._waiting[handler]

    def _close(self, handler: _Handler) -> None:
        self._waiting.pop(handler, None)
        self._answering.pop(handler, None)
        if handler.transport is not None:
            handler.transport.abort()  # at once: nothing more is sent
