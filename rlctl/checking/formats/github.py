"""A report as GitHub Actions annotations: workflow commands that put findings beside the class's line."""

import os
from pathlib import Path

from rlctl.checking.check import CheckReport
from rlctl.checking.formats.plain import summary
from rlctl.checking.rules import RuleFinding, Severity

COMMANDS = {Severity.ERROR: "error", Severity.WARNING: "warning", Severity.INFO: "notice"}


def text(report: CheckReport) -> str:
    """Return a line per finding, and one that says what was found."""
    lines = [_annotation(finding, _place(report.locate(finding))) for finding in report.verdict.findings]
    lines += [f"::error title={name} crashed::a bug in rlctl" for name in report.verdict.crashed]
    return "\n".join([*lines, summary(report)]) + "\n"


def _annotation(finding: RuleFinding, place: str) -> str:
    title = _property(f"{finding.rule} {finding.name}")
    message = _data(f"{finding.message}\nfix: {finding.fix}")
    return f"::{COMMANDS[finding.severity]} {place}title={title}::{message}"


def _place(place: tuple[Path, int] | None) -> str:
    """Return file and line as properties; empty for a file outside the repository, which cannot be annotated."""
    if place is None:
        return ""
    file, line = place
    root = Path(os.environ.get("GITHUB_WORKSPACE", Path.cwd())).resolve()
    if not file.resolve().is_relative_to(root):
        return ""
    return f"file={_property(file.resolve().relative_to(root).as_posix())},line={line},"


def _data(text: str) -> str:
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    return _data(text).replace(":", "%3A").replace(",", "%2C")
