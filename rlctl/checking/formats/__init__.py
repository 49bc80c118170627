"""The forms a report comes in; each turns a report into text."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from rlctl import output
from rlctl.checking.check import CheckReport
from rlctl.checking.formats import github, plain, sarif, structured
from rlctl.errors import UsageError
from rlctl.storage import files

FORMATS: dict[str, Callable[[CheckReport], str]] = {
    "text": plain.text,
    "json": structured.text,
    "sarif": sarif.text,
    "github": github.text,
}


def choose(form: str | None, target: str | None, json: str | None) -> tuple[str, str | None]:
    """Return format and file, of `--format`, `-o` and `--json`; raises `UsageError` for what does not go together."""
    if json is not None:
        if form not in (None, "json") or target is not None:
            raise UsageError("--json FILE is --format json -o FILE: leave out --format and -o")
        return "json", json
    return form or "text", target


def show(report: CheckReport, form: str, target: str | None) -> None:
    """Print a report, or write it to a file (`-`: stdout) and say so on stderr."""
    for name, trace in report.verdict.crashed.items():
        print(f"{name} crashed, a bug in rlctl:\n{trace}", file=sys.stderr)
    if target not in (None, "-"):
        files.write_text(Path(str(target)), FORMATS[form](report))
        print(f"{plain.summary(report)}; written to {target}", file=sys.stderr)
    elif form == "text":
        plain.show(report)
    else:
        output.results().write(FORMATS[form](report))
        output.results().flush()
