"""How long the command line takes to answer."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

from tests.benchmarks.row import Row, side_by_side


def help_page(repeat: int) -> Row:
    """Count the wall time of a process, from start to end."""
    typer_app = Path(__file__).with_name("typer_app.py")
    pair = side_by_side(
        lambda: _seconds(["-m", "rlctl", "--help"]), lambda: _seconds([str(typer_app), "--help"]), max(15, 7 * repeat)
    )
    return Row(
        "rlctl --help",
        f"{pair.ours:.2f} s",
        f"{pair.theirs:.2f} s",
        f"{pair.ratio:.2f}x",
        "<= 1.3x",
        pair.ratio <= 1.3,
        "against --help of a Typer app of one command; process start to end",
    )


def _seconds(arguments: list[str]) -> float:
    began = time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.PIPE)
    return time.perf_counter() - began
