"""Lines that environments print: read whole, thinned out, and harmless for a terminal."""

import os

from rlctl.processes.child_process import MAX_LINE_BYTES, MAX_LINES_PER_S, LineFilter, LineReader


def forward_lines(content: bytes, receive=None):
    lines = []
    printed = LineFilter(receive or lines.append)
    reader = LineReader(printed.line, MAX_LINE_BYTES)
    with os.fdopen(os.dup(reader.descriptor), "wb") as pipe:
        pipe.write(content)
    reader.close_descriptor()
    reader.wait(timeout_s=120)
    printed.end()
    return lines


def test_what_is_printed_comes_line_by_line():
    assert forward_lines(b"one\ntwo\n\ntwo\ntwo\nthree") == ["one", "two", "", "two", "three"]


def test_a_warning_of_pybullet_comes_once_and_whole():
    warning = b"b3Warning[examples/Importers/URDF.cpp,126]:\nNo inertial data for link 'hand'\n"
    other = b"b3Warning[examples/Importers/URDF.cpp,126]:\nNo inertial data for link 'wrist'\n"
    assert forward_lines((warning + other) * 64 + b"done\n") == [
        "b3Warning[examples/Importers/URDF.cpp,126]: No inertial data for link 'hand'",
        "b3Warning[examples/Importers/URDF.cpp,126]: No inertial data for link 'wrist'",
        "done",
    ]


def test_what_would_upset_a_terminal():
    assert forward_lines(b"\x1b[2J\x07\x00 caf\xc3\xa9 \xff\tend\r\n") == [
        "\ufffd[2J\ufffd\ufffd caf\u00e9 \ufffd\tend"
    ]
    assert forward_lines("\u202eabc".encode()) == ["\ufffdabc"]


def test_a_flood_is_counted():
    lines = forward_lines(b"".join(b"%d\n" % number for number in range(200_000)) + b"z" * 10 * MAX_LINE_BYTES)
    assert lines[:2] == ["0", "1"]
    assert max(map(len, lines)) <= MAX_LINE_BYTES
    left_out = [int(line.split()[0].strip("(").replace(",", "")) for line in lines if "left out" in line]
    # The last line comes in ten parts, all alike: one of them counts.
    assert sum(left_out) + len(lines) - len(left_out) == 200_001
    # So many for each second that it takes, and a line that counts the others.
    assert MAX_LINES_PER_S < len(lines) < 200_000 / 10


def test_nobody_to_tell():
    def closed(_):
        raise BrokenPipeError

    forward_lines(b"one line\nand another\n" * 50_000, closed)
