"""What a training shows on a terminal, before its first step and after a resume."""

import io
import re
import time

import pytest
from rich.console import Console

from rlctl.runs.directory import RunDirectory
from rlctl.training import display as display_module
from rlctl.training.display import Display, LiveDisplay

ROW = {"steps": 640, "fps": 1234.0, "return": 5.5, "success": 0.25, "term/distance": -3.5, "term/effort": None}


def draw(display: LiveDisplay, width: int) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(display)
    return console.file.getvalue()


@pytest.fixture
def display():
    return LiveDisplay("train reach (ppo)", 1000)


def test_a_phase_is_named_until_the_first_step(display):
    display.phase("building 64 environments, importing PyTorch")
    assert "building 64 environments, importing PyTorch ... 0:00" in draw(display, 80)
    display.phase("first steps")
    assert "building" not in draw(display, 80)
    assert "first steps ... 0:00" in draw(display, 80)
    display.steps(64)
    assert "first steps" not in draw(display, 80)


def test_a_log_names_a_phase_before_the_first_step_that_takes_long(monkeypatch, capsys):
    monkeypatch.setattr(display_module, "_LONG_START_S", 0.05)
    with Display("train reach (ppo)", 1000) as log:
        for text in ("short", "building 64 environments"):
            log.phase(text)
        time.sleep(0.2)
        log.steps(64)
        log.phase("evaluating")
        time.sleep(0.1)
    assert capsys.readouterr().err.splitlines() == ["train reach (ppo)", "building 64 environments"]


def test_an_evaluation_is_named_until_it_ends(display):
    display.steps(64)
    display.phase("evaluating")
    assert "evaluating" in draw(display, 80)
    display.evaluation(64, 0.5, 3.0, True)
    assert "evaluating" not in draw(display, 80)
    assert "✓ eval at 64: success 50.0%  return 3.00  best" in draw(display, 80)


def test_a_wide_terminal_has_folder_time_and_terms(display, tmp_path):
    display.run_folder(RunDirectory(tmp_path))
    display.metrics(ROW)
    wide, narrow = draw(display, 160), draw(display, 80)
    assert str(tmp_path)[:100] in wide
    assert re.search(r"\d:\d\d elapsed", wide)
    assert "terms   distance -3.5\n" in wide
    assert "elapsed" not in narrow
    assert "terms" not in narrow
    for drawn in (wide, narrow):
        assert "640/1,000 1,234 steps/s" in drawn
        assert "25.0%" in drawn
    assert max(len(line.rstrip()) for line in wide.splitlines()) > 120
    assert max(len(line.rstrip()) for line in narrow.splitlines()) <= 80


def test_a_resumed_run_shows_its_earlier_curve(display, tmp_path):
    (tmp_path / "metrics.csv").write_text("steps,fps,return,success\n10,1,-2.0,0\n20,1,,\n30,1,4.0,1.0\n")
    (tmp_path / "evals.csv").write_text("steps,success,return,episodes\n20,0.5,3.0,100\n30,0.25,9.0,100\n")
    display.run_folder(RunDirectory(tmp_path))
    drawn = draw(display, 80)
    assert "return  ▁█ 4.00" in drawn
    assert "success ▁█ 100%" in drawn
    assert "eval at 20: success 50.0%  return 3.00  best" in drawn
    assert "eval at 30: success 25.0%  return 9.00\n" in drawn.replace(" \n", "\n")
