"""Packets of the UDP protocol; `examples/cpp/rlctl_robot.h` declares the same struct for C and C++."""

import enum
import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

MAGIC, VERSION = 0x52434C52, 2  # the bytes "RLCR"
MOST_VALUES = 1024
_HEADER = struct.Struct("<IHHQddIIIHH")


class Kind(enum.IntEnum):
    """What a packet is."""

    HELLO = 1  # from the program: begin; in place of values the key, if one is needed
    OBSERVATION = 2  # from the robot: what the policy observes
    MEASUREMENT = 3  # from the robot: the inputs of a controller
    COMMAND = 4  # from the program: the header of what came with this kind, and the command
    NO_COMMAND = 5  # from the program: the same, without a command
    END = 6  # from the robot: the test is over


class Packet(NamedTuple):
    """A packet. `values` are what was measured or a command, shape (size,)."""

    kind: Kind
    session: int = 0  # drawn by the robot; commands repeat it
    time_s: float = 0.0  # when it was measured, from the start of the episode [s]
    age_s: float = 0.0  # how old the measurement is when it comes [s]
    sequence: int = 0  # of the observation, from 1, over all episodes
    episode: int = 0
    step: int = 0
    sizes: tuple[int, int] = (0, 0)  # number of values that were measured, and of a command
    values: NDArray[np.float32] = np.zeros(0, np.float32)
    key: bytes = b""


def pack(packet: Packet) -> bytes:
    """Return the bytes of a packet, little-endian."""
    times = (packet.time_s, packet.age_s)
    numbers = (packet.kind, packet.session, *times, packet.sequence, packet.episode, packet.step)
    return _HEADER.pack(MAGIC, VERSION, *numbers, *packet.sizes) + packet.values.astype("<f4").tobytes() + packet.key


def unpack(content: bytes) -> Packet:
    """Read a packet; raises `ValueError` with the reason for anything else."""
    if len(content) < _HEADER.size:
        raise ValueError(f"{len(content)} bytes, fewer than the header's {_HEADER.size}")
    magic, version, kind, session, time_s, age_s, sequence, episode, step, *sizes = _HEADER.unpack_from(content)
    if magic != MAGIC or version != VERSION:
        raise ValueError(f"magic {magic:#x}, version {version}; this robot has {MAGIC:#x}, version {VERSION}")
    if kind not in list(Kind):
        raise ValueError(f"kind {kind} is unknown")
    packet = Packet(Kind(kind), session, time_s, age_s, sequence, episode, step, (sizes[0], sizes[1]))
    body = content[_HEADER.size :]
    if packet.kind is Kind.HELLO:
        return packet._replace(key=body)
    count = {Kind.OBSERVATION: sizes[0], Kind.MEASUREMENT: sizes[0], Kind.COMMAND: sizes[1]}.get(packet.kind, 0)
    if len(body) != 4 * count:
        raise ValueError(f"{len(body)} bytes of values; {count} values have {4 * count}")
    return packet._replace(values=np.frombuffer(body, "<f4"))
