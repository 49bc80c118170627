"""The server's connections and HTTP routes: actions as JSON, orders, another policy, metrics, the live page."""

import asyncio
import math
import os
import re
import resource
import tempfile
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from aiohttp import web

from rlctl.errors import RlctlError, UsageError, did_you_mean
from rlctl.play import remote_messages as messages
from rlctl.runs.lookup import is_policy_file
from rlctl_robot.serve.access import find_problem, is_websocket
from rlctl_robot.serve.serve_request import LOOPBACK
from rlctl_robot.serve.server import PolicyServer

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
_Connection = web.RequestHandler

BACKLOG = 64  # connections that the kernel accepts before the loop sees them
_FIRST_REQUEST_S = 10.0
_NEXT_REQUEST_S = 75.0
_RESERVED_FILES = 32  # file descriptors for files, policies and logs
_HTTP_CONNECTIONS = 16  # connections for HTTP requests


def count_allowed_connections(max_clients: int) -> int:
    """Return how many connections may be open, so that a stop is always accepted; raises `UsageError` if too few."""
    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = limit - len(os.listdir("/proc/self/fd" if os.path.isdir("/proc/self/fd") else "/dev/fd"))
    allowed -= BACKLOG + _RESERVED_FILES
    if allowed < max_clients + _HTTP_CONNECTIONS:
        raise UsageError(
            f"--max-clients {max_clients}: this process may open {limit} files, which is too few; "
            f"raise the limit, ulimit -n {limit + max_clients + _HTTP_CONNECTIONS - allowed}, or allow fewer clients"
        )
    return allowed


class Connections:
    """The connections of a server, oldest first.

    A connection that sends no complete request header in time is closed. If too many are open, the server closes the
    one whose last request is the oldest, but never a WebSocket client.
    """

    def __init__(self, allowed: int) -> None:
        self._allowed = allowed
        self._until: dict[_Connection, float | None] = {}
        """The `time.monotonic()` at which each is closed; infinite during a request, None for a WebSocket client."""

    def accept(self, connection: _Connection) -> _Connection:
        """Register a new connection, and close an old one if too many are open."""
        self._until[connection] = time.monotonic() + _FIRST_REQUEST_S
        if len(self._until) > self._allowed:
            self._forget_closed()
            closable = [other for other, until in self._until.items() if until is not None]
            for other in closable[: max(0, len(self._until) - self._allowed)]:
                self._close(other)
        return connection

    @web.middleware
    async def follow(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Answer a request, and count its connection as active until then. A middleware of aiohttp."""
        connection = request.protocol
        self._until.pop(connection, None)
        self._until[connection] = None if is_websocket(request) else math.inf
        try:
            return await handler(request)
        except (ConnectionError, web.RequestPayloadError, RuntimeError):
            if connection.transport is not None:
                raise
            return web.Response(status=400)  # the client disconnected during its request; nobody receives this answer
        finally:
            self._until.pop(connection, None)
            if connection.transport is not None:
                self._until[connection] = time.monotonic() + _NEXT_REQUEST_S

    async def close_slow(self) -> None:
        """Close connections that have waited too long; runs until cancelled."""
        while True:
            await asyncio.sleep(1.0)
            self._forget_closed()
            now = time.monotonic()
            for connection in [connection for connection, until in self._until.items() if until and until < now]:
                self._close(connection)

    def _forget_closed(self) -> None:
        oldest = time.monotonic() + _FIRST_REQUEST_S - 1.0  # newer ones may not be connected yet
        self._until = {
            connection: until
            for connection, until in self._until.items()
            if connection.transport is not None or until is None or until >= oldest
        }

    def _close(self, connection: _Connection) -> None:
        self._until.pop(connection, None)
        if connection.transport is not None:
            connection.transport.abort()  # at once: nothing more is sent


_MAX_POLICY_SIZE = 64 * 2**20  # [bytes]
_BODY_TIMEOUT_S = 10.0
_FILE_NAME = re.compile(r"[A-Za-z0-9_. +-]{1,100}")
_ORDERS = ("stop", "home", "hold", "resume")


class Routes:
    """The HTTP routes of a policy server."""

    def __init__(self, server: PolicyServer, connections: Connections) -> None:
        self.server, self.connections = server, connections
        self.page = (Path(__file__).parent / "page.html").read_text("utf-8")

    def make_app(self) -> web.Application:
        """Return the web application."""
        middlewares = [self.connections.follow, self._check_access]
        app = web.Application(middlewares=middlewares, client_max_size=_MAX_POLICY_SIZE)
        app.add_routes(
            [
                web.get("/", self._serve_root),
                web.get("/healthz", _answer_health),
                web.get("/metadata", self._serve_metadata),
                web.get("/metrics", self._serve_metrics),
                web.get("/live", self._serve_live),
                web.post("/act", self._serve_act),
                web.post("/override", self._serve_override),
                web.post("/policy", self._serve_policy),
                *(web.post(f"/{order}", self._serve_order) for order in _ORDERS),
            ]
        )
        app.cleanup_ctx.append(self._watch)
        return app

    @web.middleware
    async def _check_access(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse requests without the key (`Authorization: Api-Key KEY`) and requests from other sites' pages."""
        if "Content-Encoding" in request.headers:
            return _refuse(415, "compressed bodies are refused")
        problem = find_problem(request, self.server.request.host in LOOPBACK, self.server.api_key)
        if problem is None:
            try:
                return await handler(request)
            except web.HTTPClientError as error:  # an unknown path, another method, too long a body
                paths = [resource.canonical for resource in request.app.router.resources()]
                known = [path for path in paths if path.removeprefix("/") not in _ORDERS]  # orders are no suggestions
                hint = did_you_mean(request.path, known) if error.status == 404 else ""
                return _refuse(error.status, f"{request.method} {request.path}: {error.reason}.{hint}")
        self.server.measurements.refused += 1
        return _refuse(*problem)

    async def _watch(self, app: web.Application) -> Any:
        work = (self.server.check_watchdogs(), self.server.write_recording(), self.connections.close_slow())
        tasks = [asyncio.create_task(task) for task in work]
        yield
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self.server.close()

    async def _serve_root(self, request: web.Request) -> web.StreamResponse:
        if is_websocket(request):
            return await self.server.serve_client(request)
        policy = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'"
        return web.Response(text=self.page, content_type="text/html", headers={"Content-Security-Policy": policy})

    async def _serve_act(self, request: web.Request) -> web.Response:
        begin, server = time.perf_counter(), self.server
        try:
            content = messages.parse_json(await _read_body(request, server.largest_message))
        except messages.MessageError as error:
            server.measurements.errors += 1
            return _refuse(400, str(error))
        answer = server.posting.answer(content)
        server.measure(server.posting, answer, time.perf_counter() - begin)
        return web.json_response(messages.as_json(answer), status=400 if "error" in answer else 200)

    async def _serve_order(self, request: web.Request) -> web.Response:
        order = request.path[1:]
        try:
            clients = self.server.give_order(order)
        except RlctlError as error:
            return _refuse(409, str(error))
        return web.json_response({"order": order, "clients": clients})

    async def _serve_override(self, request: web.Request) -> web.Response:
        """Override the actions of all clients, `{"action": [...]}`; null ends the override.

        Where the action is outside the bounds of the policy's actions, the answer has what is done: `limited_to`.
        """
        try:
            content = messages.parse_json(await _read_body(request, 64 * 1024))
            if not isinstance(content, dict) or list(content) != ["action"]:
                raise ValueError('send {"action": [numbers]}, or {"action": null} to end the override')
            bounded = self.server.override(content["action"])
        except (ValueError, TypeError) as error:
            return _refuse(400, str(error))
        answer: dict[str, Any] = {"overridden": content["action"] is not None}
        if bounded is not None:
            answer["limited_to"] = bounded
        return web.json_response(answer)

    async def _serve_policy(self, request: web.Request) -> web.Response:
        content = await _read_body(request, _MAX_POLICY_SIZE)
        name = Path(request.query.get("name", "")).name
        if not (_FILE_NAME.fullmatch(name) and is_policy_file(name)):
            # The format of safetensors begins with the length of its header, in JSON.
            name = "uploaded.safetensors" if content[8:9] == b"{" else "uploaded.onnx"
        with tempfile.TemporaryDirectory(prefix="rlctl-") as folder:
            file = Path(folder) / name
            await asyncio.to_thread(file.write_bytes, content)
            try:
                await self.server.replace_policy(file)
            except RlctlError as error:
                return _refuse(422, str(error).replace(f"{folder}/", ""))
        policy = self.server.policy
        return web.json_response({"policy": policy.file.name, "training_steps": policy.info.training_steps})

    async def _serve_metadata(self, request: web.Request) -> web.Response:
        return web.json_response(messages.as_json(self.server.metadata))

    async def _serve_metrics(self, request: web.Request) -> web.Response:
        self.server.measure_spread()
        server = self.server
        text = server.measurements.format_prometheus(server.count_states(), server.count_interventions())
        return web.Response(text=text, content_type="text/plain", charset="utf-8")

    async def _serve_live(self, request: web.Request) -> web.Response:
        return web.json_response(messages.as_json(self.server.describe()))


async def _answer_health(request: web.Request) -> web.Response:
    return web.Response(text="OK\n")


async def _read_body(request: web.Request, max_size: int) -> bytes:
    try:
        async with asyncio.timeout(_BODY_TIMEOUT_S):
            return await request.clone(client_max_size=max_size).read()
    except TimeoutError:
        raise web.HTTPRequestTimeout from None


def _refuse(status: int, text: str) -> web.Response:
    return web.json_response({"error": text}, status=status)
