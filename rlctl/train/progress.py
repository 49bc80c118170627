"""What a training must remember over a resume, and its growing tables, which a resume cuts back."""

from __future__ import annotations

import csv
import dataclasses
import io
from pathlib import Path
from typing import Any

from rlctl.run import files
from rlctl.run.directory import RunDirectory


@dataclasses.dataclass
class Progress:
    """What the loop must remember over a resume; plain data."""

    next_eval: int
    best_success: float | None = None
    best_return: float | None = None
    best_step: int | None = None
    last_eval_step: int | None = None
    good_in_a_row: int = 0
    seconds: float = 0.0
    metrics_bytes: int = 0
    evals_bytes: int = 0
    episodes_started: list[int] = dataclasses.field(default_factory=list)
    stage: int = 0
    """Stage of the curriculum, from 1; 0 where there is none."""
    stage_began: int = 0
    """Environment steps before the stage began."""
    stage_episodes: list[float | None] = dataclasses.field(default_factory=list)
    """Success (0 or 1, None where not reported) or return of the stage's last episodes, as its rule wants them."""


def append_row(path: Path, row: dict[str, Any]) -> None:
    """Append a row to a CSV table, after its header if the table is new; None becomes an empty field."""
    text = io.StringIO()
    writer = csv.DictWriter(text, row)
    if not path.exists():
        writer.writeheader()
    writer.writerow({key: "" if value is None else value for key, value in row.items()})
    files.append_line(path, text.getvalue().replace("\r\n", "\n").rstrip("\n"))


def table_size(path: Path) -> int:
    """Return a table's size in bytes; 0 if it is not there yet."""
    return path.stat().st_size if path.exists() else 0


def cut_back(run: RunDirectory, progress: Progress) -> None:
    """Cut the growing tables back to a checkpoint, so that no row is there twice."""
    for path, size in ((run.metrics_file, progress.metrics_bytes), (run.evals_file, progress.evals_bytes)):
        if path.exists() and path.stat().st_size > size:
            with path.open("r+b") as file:
                file.truncate(size)
