"""The program under test: what the sensors measure goes to it, its commands come back; and its connection by UDP."""

import abc
import asyncio
import collections
import hmac
import secrets
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlctl_robot.robot import packets
from rlctl_robot.robot.packets import Kind, Packet

_ANSWERS = (Kind.COMMAND, Kind.NO_COMMAND)
_END_COPIES = 3  # of the last packet, because one may be lost


class SentObservation(NamedTuple):
    """What the sensors measure at a step, as it is sent."""

    sequence: int  # from 1, over all episodes
    episode: int
    step: int
    parts: dict[str, NDArray[Any]]
    begins: bool = False  # whether it is the first that is sent in its episode
    time_s: float = 0.0  # when it was measured, from the start of the episode [s]
    age_s: float = 0.0  # how old it is when the program gets it: the delay of a fault [s]


class Arrival(NamedTuple):
    """A message of the program: the command for an observation, or what is wrong with it."""

    sequence: int
    at: float  # time of the event loop [s]
    values: Any = None  # None: it commands nothing
    problem: str = ""


class ControlProgram(abc.ABC):
    """A connected program."""

    resends = False
    """Whether an observation must be sent again that is not answered."""

    def __init__(self, name: str, loop: asyncio.AbstractEventLoop) -> None:
        self.name = name
        self.arrivals: collections.deque[Arrival] = collections.deque()
        self.closed = False
        self._loop = loop
        self._waiter: asyncio.Future[None] | None = None

    @abc.abstractmethod
    async def send(self, observation: SentObservation) -> None:
        """Send an observation."""

    @abc.abstractmethod
    async def end(self) -> None:
        """Say that the test is over."""

    async def wait(self, until: float) -> None:
        """Return when something has arrived, the connection has closed, or at the event loop's time `until` [s]."""
        if self.arrivals or self.closed:
            return
        self._waiter = self._loop.create_future()
        timer = self._loop.call_at(until, self._wake)
        try:
            await self._waiter
        finally:
            timer.cancel()
            self._waiter = None

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)

    def _deliver(self, sequence: int, values: Any = None, problem: str = "") -> None:
        self.arrivals.append(Arrival(sequence, self._loop.time(), values, problem))
        self._wake()


class UdpController(ControlProgram, asyncio.DatagramProtocol):
    """The first program that says hello at the robot's UDP port, with the key if one is needed."""

    resends = True

    def __init__(
        self, loop: asyncio.AbstractEventLoop, sizes: tuple[int, int], key: str | None, *, sends: Kind
    ) -> None:
        super().__init__("udp", loop)
        self.connected: asyncio.Future[None] = loop.create_future()
        self.refused = 0  # packets of others, and what is no packet
        self._sizes, self._key, self._sends = sizes, key, sends
        self._session = secrets.randbits(64)
        self._address: Any = None
        self._transport: asyncio.DatagramTransport

    def connection_made(self, transport: Any) -> None:
        """Take the socket; asyncio calls it."""
        self._transport = transport

    def datagram_received(self, data: bytes, address: Any) -> None:
        """Read a packet; asyncio calls it."""
        try:
            packet = packets.unpack(data)
        except ValueError as error:
            if address == self._address:
                self._deliver(0, problem=str(error))
            else:
                self.refused += 1
            return
        if packet.kind is Kind.HELLO and self._address is None and self._accepts(packet.key):
            self._address, self.name = address, f"udp {address[0]}:{address[1]}"
            self.connected.set_result(None)
        elif packet.kind in _ANSWERS and address == self._address and packet.session == self._session:
            self._deliver(packet.sequence, packet.values if packet.kind is Kind.COMMAND else None)
        elif packet.kind is not Kind.HELLO or address != self._address:  # a hello is repeated until it is answered
            self.refused += 1

    def _accepts(self, key: bytes) -> bool:
        return self._key is None or hmac.compare_digest(key, self._key.encode())

    def error_received(self, exc: Exception) -> None:
        """Ignore that nobody listens: the program may start again; asyncio calls it."""

    async def send(self, observation: SentObservation) -> None:
        """Send what was measured, in the order of its names."""
        values = np.concatenate([part.ravel() for part in observation.parts.values()]).astype(np.float32)
        numbers = (observation.sequence, observation.episode, observation.step)
        times = (observation.time_s, observation.age_s)
        self._send(Packet(self._sends, self._session, *times, *numbers, self._sizes, values))

    def _send(self, packet: Packet) -> None:
        self._transport.sendto(packets.pack(packet), self._address)

    async def end(self) -> None:
        """Send the packet that ends the test."""
        if self._address is not None:
            for _ in range(_END_COPIES):
                self._send(Packet(Kind.END, self._session, sizes=self._sizes))
