"""The robot's port: UDP and, where aiohttp is installed, TCP for a WebSocket, until a program connects."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import TYPE_CHECKING, Any

from rlctl.errors import AnswerIsNo, UsageError
from rlctl_robot.robot.packets import Kind
from rlctl_robot.robot.program import ControlProgram, UdpController
from rlctl_robot.robot.robot_request import RobotRequest

if TYPE_CHECKING:
    from rlctl_robot.robot.websocket import Door

_ACCEPTED_AT_ONCE = 32  # connections that are accepted before the oldest ones are closed
_PORT_TRIES = 20  # until TCP and UDP have the same free port


@contextlib.asynccontextmanager
async def wait_for_controller(
    request: RobotRequest,
    key: str | None,
    door: Door | None,
    udp_sizes: tuple[int, int] | None,
    on_start: Callable[[list[str]], None],
) -> AsyncIterator[ControlProgram]:
    """Listen, call `on_start` with the addresses, and yield the first program that connects.

    `door` takes WebSocket clients; None: only UDP. `udp_sizes` are the numbers of values that are sent and taken;
    None: no UDP. Raises `UsageError` for a port that is not free, `AnswerIsNo` if no program connects in time.
    """
    sends = Kind.MEASUREMENT if request.controller else Kind.OBSERVATION
    udp = None if udp_sizes is None else UdpController(asyncio.get_running_loop(), udp_sizes, key, sends=sends)
    opened = await _open(request, door, udp)
    try:
        place = f"{f'[{request.host}]' if ':' in request.host else request.host}:{opened.port}"
        on_start([*([f"ws://{place}"] if door else []), *([f"udp://{place}"] if udp else [])])
        yield await _wait(door, udp, request.timeout_s)
    finally:
        opened.close()
        if door is not None:
            await door.server.shutdown(1.0)


async def _wait(door: Door | None, udp: UdpController | None, timeout_s: float) -> ControlProgram:
    waiting: set[asyncio.Future[Any]] = {listener.connected for listener in (door, udp) if listener is not None}
    done, _ = await asyncio.wait(waiting, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
    if not done:
        refused = f"; {udp.refused} UDP packets were refused" if udp is not None and udp.refused else ""
        raise AnswerIsNo(f"no program has connected for {timeout_s:g} s{refused}; --timeout sets how long to wait")
    if door is not None:
        door.taken = True
        if door.connected in done:
            return door.connected.result()
    assert udp is not None
    return udp


class _Opened:
    """The open sockets of one port."""

    def __init__(self) -> None:
        self.listener: asyncio.Server | None = None
        self.transport: asyncio.DatagramTransport | None = None

    @property
    def port(self) -> int:
        """The port that TCP or, without it, UDP has."""
        if self.listener is not None:
            return int(self.listener.sockets[0].getsockname()[1])
        assert self.transport is not None
        return int(self.transport.get_extra_info("sockname")[1])

    def close(self) -> None:
        """Close them."""
        if self.listener is not None:
            self.listener.close()
        if self.transport is not None:
            self.transport.close()


async def _open(request: RobotRequest, door: Door | None, udp: UdpController | None) -> _Opened:
    """Listen on the same port with TCP and UDP."""
    loop, tries = asyncio.get_running_loop(), _PORT_TRIES if request.port == 0 else 1
    for last in range(tries - 1, -1, -1):
        opened = _Opened()
        try:
            if door is not None:
                opened.listener = await loop.create_server(
                    door.accept, request.host, request.port, backlog=_ACCEPTED_AT_ONCE
                )
            if udp is not None:
                port = request.port if door is None else opened.port
                opened.transport, _ = await loop.create_datagram_endpoint(lambda: udp, local_addr=(request.host, port))
            return opened
        except OSError as error:
            opened.close()
            if not last:
                reason = f"{error.strerror or error}; --port 0 takes any free port"
                raise UsageError(f"--host {request.host} --port {request.port}: {reason}") from None
    raise AssertionError
