"""Lines that environments and libraries print: read whole, shown once, counted, and harmless for a terminal."""

import os

import pytest

from rlctl import printed_lines
from rlctl.printed_lines import MAX_LINE_BYTES, MAX_LINES_PER_S, PrintedLines


def forward_lines(content: bytes, receive=None, file=None):
    lines = []
    printed = PrintedLines(receive or lines.append)
    if file is not None:
        printed.log_to(file)
    reader = printed.open_reader()
    with os.fdopen(os.dup(reader.descriptor), "wb") as pipe:
        pipe.write(content)
    reader.close_descriptor()
    reader.wait(timeout_s=120)
    printed.end()
    return lines


def test_each_line_comes_once_with_a_count():
    lines = forward_lines(b"one\ntwo\n\ntwo\nthree\ntwo\none")
    assert lines == ["one", "two", "three", "(3 times: two)", "(2 times: one)"]
    assert forward_lines(b"".join(b"gain %d\n" % number for number in range(3)) * 8) == [
        *("gain 0", "gain 1", "gain 2"),
        "(8 times each: gain 0 and 2 other lines)",
    ]


def test_a_report_names_what_has_doubled_since_the_last_one():
    lines = []
    printed = PrintedLines(lines.append)
    for text in ("one", "one", "two"):
        printed.line(text)
    for _ in range(2):
        printed.report()
    for text in ("two", "one", "one"):
        printed.line(text)
    printed.report()
    printed.line("one")
    printed.end()
    assert lines == ["one", "two", "(2 times: one)", "(2 times: two)", "(5 times: one)"]


def test_a_file_has_all_lines_also_those_before_it(tmp_path):
    file, lines = tmp_path / "printed.log", []
    printed = PrintedLines(lines.append)
    printed.log_to(tmp_path / "not" / "there")  # its error changes nothing
    printed.line("lost")
    printed.log_to(file)
    assert not file.exists()
    for text in ("one", "two", "one"):
        printed.line(text)
    printed.end()
    assert file.read_text() == "one\ntwo\none\n"
    assert lines[-1] == f"(2 times: one; all lines: {file})"
    assert forward_lines(b"three\n", file=file) == ["three"]  # as a resumed training
    assert file.read_text() == "one\ntwo\none\nthree\n"


def test_the_file_is_limited(tmp_path, monkeypatch):
    monkeypatch.setattr(printed_lines, "MAX_LOG_BYTES", 10)
    forward_lines(b"one\ntwo\nthree\nfour\n", file=tmp_path / "printed.log")
    limited = "one\ntwo\nthree\n(more lines are left out)\n"
    assert (tmp_path / "printed.log").read_text() == limited
    forward_lines(b"five\n", file=tmp_path / "printed.log")
    assert (tmp_path / "printed.log").read_text() == limited


def test_a_warning_of_pybullet_comes_once_and_whole():
    head = b"b3Warning[examples/Importers/BulletUrdfImporter.cpp,126]:\n"
    warning = head + b"No inertial data for link, using mass=1" + head + b"hand"  # no line break, as PyBullet prints it
    assert forward_lines(b"argv[0]=\n" + 64 * warning + head + b"done\npybullet build time: Jan 29\n") == [
        "b3Warning[BulletUrdfImporter.cpp,126]: No inertial data for link, using mass=1",
        "b3Warning[BulletUrdfImporter.cpp,126]: hand",
        "b3Warning[BulletUrdfImporter.cpp,126]: done",
        "(64 times each: b3Warning[BulletUrdfImporter.cpp,126]: No inertial data f... and 1 other line)",
    ]


def test_processes_print_at_the_same_time():
    lines = []
    printed = PrintedLines(lines.append)
    readers = [printed.open_reader() for _ in range(2)]
    for text in (b"b3Warning[a.cpp,1]:\n", b"no mass\n", b"half", b" a line\n"):
        for reader in readers:
            os.write(reader.descriptor, text)
    for reader in readers:
        reader.close_descriptor()
        reader.wait()
    printed.end()
    assert lines == [
        "b3Warning[a.cpp,1]: no mass",
        "half a line",
        "(2 times each: b3Warning[a.cpp,1]: no mass and 1 other line)",
    ]


def test_what_would_upset_a_terminal():
    assert forward_lines(b"\x1b[2J\x07\x00 caf\xc3\xa9 \xff\tend\r\n") == ["\ufffd\ufffd caf\u00e9 \ufffd\tend"]
    assert forward_lines("\u202eabc".encode()) == ["\ufffdabc"]
    assert forward_lines(b"\x1b[33mWARN: old\x1b[0m\n\x1b]0;title\x07\n") == ["WARN: old"]


@pytest.mark.slow
def test_a_flood_is_counted():
    lines = forward_lines(b"".join(b"%d\n" % number for number in range(200_000)) + b"z" * 10 * MAX_LINE_BYTES)
    assert lines[:2] == ["0", "1"]
    assert max(map(len, lines)) <= MAX_LINE_BYTES
    left_out = [int(line.split()[0].strip("(").replace(",", "")) for line in lines if "left out" in line]
    # The last line comes in ten parts, all alike: one of them counts, and a line says that it came ten times.
    assert lines[-1].startswith("(10 times: zzz")
    assert sum(left_out) + len(lines) - 1 - len(left_out) == 200_001
    # So many for each second that it takes, and a line that counts the others.
    assert MAX_LINES_PER_S < len(lines) < 200_000 / 10


@pytest.mark.slow
def test_nobody_to_tell():
    def closed(_):
        raise BrokenPipeError

    forward_lines(b"one line\nand another\n" * 50_000, closed)
