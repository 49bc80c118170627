"""A text for a bug report: versions, platform, a run's recipe, its last lines and diagnosis, nothing personal."""

import getpass
import os
import platform
import re
import socket
from pathlib import Path

from rlctl.errors import ArtifactError, RlctlError
from rlctl.runs.diagnosis.findings import diagnose, format_findings
from rlctl.runs.directory import RunDirectory
from rlctl.runs.lookup import find_run
from rlctl.runs.tables import read_table
from rlctl.version import __version__, collect_versions

_LINES = 20  # last lines of a table or log
_SECRET_NAME = re.compile(r"key|token|secret|passw", re.IGNORECASE)
_SECRET = re.compile(
    r"(?<=://)[^/\s@]+:[^/\s@]+(?=@)"  # name and password in an address
    r"|\b(?:hf|ghp|gho|github_pat|sk|xox[bp]|AKIA)[-_]?[A-Za-z0-9_-]{16,}"
    r"|(?i:(?<=key=)|(?<=token=)|(?<=secret=)|(?<=password=))[^\s&'\",]+"
)
_MAIL = re.compile(r"[\w.+-]+@[\w-]+\.[\w.-]+")


def write_bug_report(name: str | None) -> str:
    """Return the report of a run as Markdown; without a name of the newest run, or of the installation alone.

    Raises `ArtifactError` for a named run that is missing.
    """
    try:
        run = find_run(name)
    except ArtifactError:
        if name is not None:
            raise
        run = None
    versions = collect_versions()
    parts = [
        f"rlctl {__version__}, Python {platform.python_version()}, {platform.platform()}, {os.cpu_count()} cores",
        ", ".join(f"{name} {version}" for name, version in versions.items() if name not in ("python", "rlctl")),
        _describe_run(run) if run is not None else "no run",
    ]
    return remove_personal("\n\n".join(parts)) + "\n"


def _describe_run(run: RunDirectory) -> str:
    try:
        status, recipe = run.status(), run.recipe_file.read_text()
        findings = format_findings(diagnose(run))
    except (RlctlError, OSError) as error:
        return f"the run cannot be read: {error}"
    command = " ".join(map(str, status.get("command", [])))
    changed = {name: version for name, version in status.get("versions", {}).items() if _differs(name, version)}
    parts = [
        f"command: `{command}`",
        f"status: {status.get('status')}, {status.get('steps', 0):,} steps, error: {status.get('error')}",
        *([f"versions of the run that differ from those above: {changed}"] if changed else []),
        _fence("recipe", recipe, "yaml"),
        _fence("diagnosis", "\n".join(findings) or "nothing found"),
        *(_fence(path.name, _last_lines(path)) for path in (run.evals_file, run.metrics_file, run.printed_file)),
    ]
    return "\n\n".join(part for part in parts if part)


def _differs(name: str, version: str) -> bool:
    return collect_versions().get(name) != version


def _fence(title: str, text: str, language: str = "") -> str:
    return f"{title}:\n```{language}\n{text.rstrip()}\n```" if text.strip() else ""


def _last_lines(path: Path) -> str:
    """Return the last lines of a file; of a table its columns that are not empty, in the form `name value`."""
    if not path.is_file():
        return ""
    if path.suffix != ".csv":
        return "\n".join(path.read_text(errors="replace").splitlines()[-_LINES:])
    rows = read_table(path)[-3:]
    return "\n".join(
        ", ".join(f"{name} {value:.6g}" for name, value in row.items() if value is not None) for row in rows
    )


def remove_personal(text: str) -> str:
    """Return a text without the home folder, names of user and machine, mail addresses, and what looks like a key."""
    for name, value in os.environ.items():
        if _SECRET_NAME.search(name) and len(value) >= 8:
            text = text.replace(value, "***")
    text = _MAIL.sub("MAIL", _SECRET.sub("***", text))
    text = text.replace(str(Path.home()), "~")
    text = re.sub(r"(/home/|/Users/)[^/\s]+", r"\1USER", text)
    for name, shown in ((_user_name(), "USER"), (socket.gethostname(), "HOST")):
        if len(name) > 2:  # a shorter one is a part of words
            text = re.sub(rf"(?<![\w-]){re.escape(name)}(?![\w-])", shown, text)
    return text


def _user_name() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # a container whose user has no name
        return ""
