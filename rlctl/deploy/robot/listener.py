"""The robot's port: TCP for a WebSocket and UDP, until a program connects to one of them."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Any

from aiohttp import web

from rlctl.deploy.robot.controller import ControlProgram, UdpController, WebSocketController
from rlctl.deploy.robot.request import RobotRequest
from rlctl.deploy.server import messages
from rlctl.deploy.server.access import find_problem, is_websocket
from rlctl.deploy.server.request import LOOPBACK
from rlctl.errors import AnswerIsNo, UsageError

_PORT_TRIES = 20  # until TCP and UDP have the same free port
_LARGEST_COMMAND = 2**20  # [bytes]


class _Door:
    """Takes the first WebSocket client as the program under test, and refuses all others."""

    def __init__(self, request: RobotRequest, key: str | None, metadata: dict[str, Any]) -> None:
        self._is_local, self._key = request.host in LOOPBACK, key
        self._metadata = messages.pack(metadata)
        self.taken = False
        self.connected: asyncio.Future[WebSocketController] = asyncio.get_running_loop().create_future()

    async def answer(self, request: web.BaseRequest) -> web.StreamResponse:
        """Answer a request."""
        if problem := find_problem(request, self._is_local, self._key):
            return web.json_response({"error": problem[1]}, status=problem[0])
        if not is_websocket(request):
            return web.json_response({"error": "this is rlctl robot: connect by WebSocket or UDP"}, status=426)
        if self.taken:
            return web.json_response({"error": "another program is connected"}, status=409)
        self.taken = True
        socket = web.WebSocketResponse(compress=False, max_msg_size=_LARGEST_COMMAND, timeout=1.0)
        await socket.prepare(request)
        await socket.send_bytes(self._metadata)
        controller = WebSocketController(f"ws {request.remote}", asyncio.get_running_loop(), socket)
        self.connected.set_result(controller)
        await controller.receive()
        return socket


@contextlib.asynccontextmanager
async def wait_for_controller(
    request: RobotRequest,
    key: str | None,
    metadata: dict[str, Any],
    udp_sizes: tuple[int, int] | None,
    on_start: Callable[[list[str]], None],
) -> AsyncIterator[ControlProgram]:
    """Listen, call `on_start` with the addresses, and yield the first program that connects.

    `udp_sizes` are the numbers of values of an observation and of an action; None: no UDP. Raises `UsageError` for a
    port that is not free, `AnswerIsNo` if no program connects in time.
    """
    loop = asyncio.get_running_loop()
    door = _Door(request, key, metadata)
    udp = None if udp_sizes is None else UdpController(loop, udp_sizes, key)
    server = web.Server(door.answer, access_log=None)
    listener, transport = await _open(request, server, udp)
    try:
        port = listener.sockets[0].getsockname()[1]
        place = f"{f'[{request.host}]' if ':' in request.host else request.host}:{port}"
        on_start([f"ws://{place}", *([f"udp://{place}"] if udp else [])])
        yield await _wait(door, udp, request.timeout_s)
    finally:
        listener.close()
        if transport is not None:
            transport.close()
        await server.shutdown(1.0)


async def _wait(door: _Door, udp: UdpController | None, timeout_s: float) -> ControlProgram:
    waiting: set[asyncio.Future[Any]] = {door.connected, *([udp.connected] if udp else [])}
    done, _ = await asyncio.wait(waiting, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
    if not done:
        refused = f"; {udp.refused} UDP packets were refused" if udp is not None and udp.refused else ""
        raise AnswerIsNo(f"no program has connected for {timeout_s:g} s{refused}; --timeout sets how long to wait")
    door.taken = True
    if door.connected in done:
        return door.connected.result()
    assert udp is not None
    return udp


async def _open(
    request: RobotRequest, server: web.Server, udp: UdpController | None
) -> tuple[asyncio.Server, asyncio.BaseTransport | None]:
    """Listen on the same port with TCP and UDP."""
    loop, tries = asyncio.get_running_loop(), _PORT_TRIES if request.port == 0 else 1
    for last in range(tries - 1, -1, -1):
        listener = None
        try:
            listener = await loop.create_server(server, request.host, request.port)
            if udp is None:
                return listener, None
            port = listener.sockets[0].getsockname()[1]
            transport, _ = await loop.create_datagram_endpoint(lambda: udp, local_addr=(request.host, port))
            return listener, transport
        except OSError as error:
            if listener is not None:
                listener.close()
            if not last:
                reason = f"{error.strerror or error}; --port 0 takes any free port"
                raise UsageError(f"--host {request.host} --port {request.port}: {reason}") from None
    raise AssertionError
