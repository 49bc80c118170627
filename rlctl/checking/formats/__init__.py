"""The forms a report comes in; each turns a report into text."""

import sys
from collections.abc import Callable
from pathlib import Path

from rlctl import output
from rlctl.checking.check import CheckReport
from rlctl.checking.formats import github, plain, sarif, structured
from rlctl.storage import files

FORMATS: dict[str, Callable[[CheckReport], str]] = {
    "text": plain.text,
    "json": structured.text,
    "sarif": sarif.text,
    "github": github.text,
}


def show(report: CheckReport, form: str, target: str | None) -> None:
    """Print a report, or write it to a file (`-`: stdout) and say so on stderr."""
    if target not in (None, "-"):
        files.write_text(Path(str(target)), FORMATS[form](report))
        print(f"{plain.summary(report)}; written to {target}", file=sys.stderr)
    elif form == "text":
        plain.show(report)
    else:
        output.results().write(FORMATS[form](report))
        output.results().flush()


def show_crashes(report: CheckReport) -> None:
    """Print the tracebacks of rules that crashed to stderr."""
    for name, trace in report.verdict.crashed.items():
        print(f"{name} crashed, a bug in rlctl:\n{trace}", file=sys.stderr)
