"""Progress on stderr: a line now and then where there is no terminal."""

import time

import pytest

from rlctl import output


@pytest.fixture(autouse=True)
def fresh_silence(monkeypatch):
    """No work before the test counts."""
    monkeypatch.setattr(output, "_silence", output._Silence())
    monkeypatch.setattr(output, "_LEAST_S", 0.01)


def test_long_work_prints_a_line_with_the_time_that_is_left(monkeypatch, capfd):
    monkeypatch.setattr(output, "_FIRST_LINE_S", 0.05)
    monkeypatch.setattr(output, "_LINES_S", (0.05, 60.0))
    with output.show_progress("filming", 900, "steps") as show:
        show(90)
        time.sleep(0.2)
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("filming: 90 of 900 steps, about ")


def test_a_single_call_prints_a_line_too(monkeypatch, capfd):
    monkeypatch.setattr(output, "_FIRST_LINE_S", 0.05)
    with output.show_progress("compiling"):
        time.sleep(0.15)
    assert capfd.readouterr().err == "compiling: 0 s so far\n"


def test_a_chain_of_short_work_is_not_silent(monkeypatch, capfd):
    monkeypatch.setattr(output, "_FIRST_LINE_S", 0.25)
    for part in range(3):
        with output.show_progress(f"part {part}"):
            time.sleep(0.1)
    lines = capfd.readouterr().err.splitlines()
    assert lines  # none of the parts alone takes so long
    assert all(line.endswith(": 0 s so far") for line in lines)


def test_short_work_prints_nothing(capfd):
    with output.show_progress("filming", 10, "steps") as show:
        show(10)
    assert capfd.readouterr().err == ""


def test_the_time_that_is_left_by_hand():
    # 100 of 400 in 30 s: the other 300 take 90 s.
    assert output.format_progress("filming", 100, 400, "steps", 30.0) == "filming: 100 of 400 steps, about 90 s left"
    assert output.format_progress("filming", 0, 400, "steps", 30.0) == "filming: 0 of 400 steps, 30 s so far"
