"""Packets of the UDP protocol, and the struct of the C header."""

import re
from pathlib import Path

import numpy as np
import pytest

from rlctl_robot.robot import packets
from rlctl_robot.robot.packets import Kind, Packet

HEADER = (Path(__file__).parents[3] / "examples" / "cpp" / "rlctl_robot.h").read_text()


def test_the_bytes_of_a_packet():
    packet = Packet(Kind.COMMAND, 0x0102030405060708, 0.5, -0.25, 9, 10, 11, (2, 1), np.array([1.5], np.float32))
    content = packets.pack(packet)
    assert content[:4] == b"RLCR"
    # version 2, kind 4; session; time, age; sequence, episode, step; sizes; 1.5
    times = "000000000000e03f 000000000000d0bf"
    rest = f"0200 0400 0807060504030201 {times} 09000000 0a000000 0b000000 0200 0100 0000c03f"
    assert content[4:] == bytes.fromhex(rest)
    again = packets.unpack(content)
    assert again[:8] == packet[:8]
    assert again.values == packet.values
    assert packets.unpack(packets.pack(Packet(Kind.HELLO, key=b"secret"))).key == b"secret"


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"RLCR", "4 bytes, fewer than the header's 48"),
        (b"x" * 60, "magic 0x78787878, version 30840; this robot has 0x52434c52, version 2"),
        (packets.pack(Packet(Kind.COMMAND, sizes=(3, 2))), "0 bytes of values; 2 values have 8"),
        (packets.pack(Packet(Kind.HELLO))[:6] + b"\x09\x00" + bytes(40), "kind 9 is unknown"),
    ],
)
def test_what_is_no_packet(content, problem):
    with pytest.raises(ValueError, match=problem):
        packets.unpack(content)


def test_the_c_header_has_the_same_numbers():
    numbers = {name: int(value.rstrip("u"), 0) for name, value in re.findall(r"RLCTL_ROBOT_(\w+) (?:= )?(\w+)", HEADER)}
    assert numbers == {
        "MAGIC": packets.MAGIC,
        "VERSION": packets.VERSION,
        "MAX_VALUES": packets.MOST_VALUES,
        "HEADER_SIZE": len(packets.pack(Packet(Kind.HELLO))),
        **{kind.name: kind.value for kind in Kind},
    }
