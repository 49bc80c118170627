"""Open connections: how long one may wait for a request, and how many there may be."""

from __future__ import annotations

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
_RESERVE = 32  # file descriptors for files, policies and logs
_POSTING = 16  # connections besides those of WebSocket clients


def count_allowed_connections(max_clients: int) -> int:
    """Return how many connections there may be, so that one with a stop is always accepted and served.

    Raises `UsageError` where this process may not open enough files for `max_clients`.
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = limit - len(os.listdir("/proc/self/fd" if os.path.isdir("/proc/self/fd") else "/dev/fd"))
    allowed -= BACKLOG + _RESERVE
    if allowed < max_clients + _POSTING:
        needed = limit + max_clients + _POSTING - allowed
        raise UsageError(
            f"--max-clients {max_clients}: this process may open {limit} files, which is too few; "
            f"raise the limit, ulimit -n {needed}, or allow fewer clients"
        )
    return allowed


class Connections:
    """The connections of a server, in the order in which they began to wait for a request.

    A connection that sends no whole request head in time is closed. Where there are too many, the one that has waited
    for longest is closed, then the one whose request has taken longest; never that of a WebSocket client.
    """

    def __init__(self, allowed: int) -> None:
        self._allowed = allowed
        self._waiting: _Times = {}  # until when
        self._answering: _Times = {}
        self._clients: _Times = {}

    def accept(self, handler: _Handler) -> _Handler:
        """Register a new connection, and close another where there are too many."""
        self._waiting[handler] = time.monotonic() + _FIRST_REQUEST_S
        if self._count() > self._allowed:
            self._forget_closed()
            for handler_to_close in [*self._waiting, *self._answering][: max(0, self._count() - self._allowed)]:
                self._close(handler_to_close)
        return handler

    @web.middleware
    async def follow(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Answer a request; its connection does not count as waiting meanwhile. A middleware of aiohttp."""
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
            return web.Response(status=400)  # the client died in its request; nobody receives this answer
        finally:
            group.pop(connection, None)
            if connection.transport is not None:
                self._waiting[connection] = time.monotonic() + _NEXT_REQUEST_S

    async def close_slow(self) -> None:
        """Close connections that have waited for too long; runs until it is cancelled."""
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
