"""A program that connects to the robot by WebSocket; needs aiohttp and msgpack, which UDP does not."""

import asyncio
import collections
from typing import Any

import aiohttp
from aiohttp import web

from rlctl.errors import short_repr
from rlctl.play import remote_messages as messages
from rlctl_robot.robot.program import ControlProgram, SentObservation
from rlctl_robot.robot.robot_request import RobotRequest
from rlctl_robot.serve.access import find_problem, is_websocket
from rlctl_robot.serve.serve_request import LOOPBACK

_LARGEST_COMMAND = 2**20  # [bytes]
_MOST_WAITING = 64
"""Connections without a program that stay open; the loop waits with select, which takes no descriptor above 1023."""


class WebSocketController(ControlProgram):
    """A program that has connected by WebSocket. An answer without a `sequence` is for the next observation in turn."""

    def __init__(self, name: str, loop: asyncio.AbstractEventLoop, socket: web.WebSocketResponse) -> None:
        super().__init__(name, loop)
        self._socket = socket
        self._sent: collections.deque[int] = collections.deque()  # sequences that are not answered yet

    async def send(self, observation: SentObservation) -> None:
        """Send an observation as a policy server's client does; `reset` begins an episode."""
        content: dict[str, Any] = dict(observation.parts)
        content["sequence"] = observation.sequence
        content["age_s"] = observation.age_s
        if observation.begins:
            content["reset"] = True
        self._sent.append(observation.sequence)
        try:
            await self._socket.send_bytes(messages.pack(content))
        except ConnectionError:
            self._close()

    async def receive(self) -> None:
        """Read the program's answers until it disconnects."""
        async for message in self._socket:
            first = self._sent.popleft() if self._sent else 0
            try:
                if message.type is not aiohttp.WSMsgType.BINARY:
                    raise messages.MessageError("text frame received; send binary frames of msgpack")
                content = messages.unpack(message.data)
                if not isinstance(content, dict) or "actions" not in content:
                    raise messages.MessageError(f"no map with actions: {short_repr(content)}")
            except messages.MessageError as error:
                self._deliver(first, problem=str(error))
                continue
            number = content.get("sequence", first)
            self._deliver(number if isinstance(number, int) else first, content["actions"])
        self._close()

    def _close(self) -> None:
        self.closed = True
        self._wake()

    async def end(self) -> None:
        """Close the connection."""
        await self._socket.close(message=b"the test is over")


class Door:
    """Takes the first WebSocket client as the program under test, and refuses all others."""

    def __init__(self, request: RobotRequest, key: str | None, metadata: dict[str, Any]) -> None:
        self._is_local, self._key = request.host in LOOPBACK, key
        self._metadata = messages.pack(metadata)
        self.server = web.Server(self.answer, access_log=None)
        self.taken = False
        self._is_opening = False  # whether a WebSocket is being opened
        self._program: asyncio.Protocol | None = None  # the connection of the program under test
        self.connected: asyncio.Future[ControlProgram] = asyncio.get_running_loop().create_future()

    def accept(self) -> asyncio.Protocol:
        """Return what handles a new connection; the oldest without the program give their places to newer ones."""
        asyncio.get_running_loop().call_soon(self._close_oldest)  # `connections` has those that are open
        return self.server()

    def _close_oldest(self) -> None:
        waiting = [connection for connection in self.server.connections if connection is not self._program]
        for connection in waiting[:-_MOST_WAITING]:
            connection.force_close()

    async def answer(self, request: web.BaseRequest) -> web.StreamResponse:
        """Answer a request."""
        if problem := find_problem(request, self._is_local, self._key):
            return web.json_response({"error": problem[1]}, status=problem[0])
        if not is_websocket(request):
            return web.json_response({"error": "this is rlctl robot: connect by WebSocket or UDP"}, status=426)
        if self.taken or self._is_opening:
            return web.json_response({"error": "another program is connected"}, status=409)
        socket = web.WebSocketResponse(compress=False, max_msg_size=_LARGEST_COMMAND, timeout=1.0)
        self._is_opening = True
        try:
            await socket.prepare(request)  # raises for a handshake that is none, which must not take the place
            await socket.send_bytes(self._metadata)
        finally:
            self._is_opening = False
        if self.taken:  # a program has connected by UDP meanwhile
            await socket.close(message=b"another program is connected")
            return socket
        self.taken, self._program = True, request.protocol
        controller = WebSocketController(f"ws {request.remote}", asyncio.get_running_loop(), socket)
        self.connected.set_result(controller)
        await controller.receive()
        return socket
