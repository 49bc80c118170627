"""SARIF files, which code scanning services read.

Format: OASIS, "Static Analysis Results Interchange Format (SARIF) Version 2.1.0".
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlctl.storage import files
from rlctl.version import __version__


def make_log(run: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a file with one run."""
    return {"$schema": "https://json.schemastore.org/sarif-2.1.0.json", "version": "2.1.0", "runs": [dict(run)]}


def write_failure(path: Path, text: str) -> None:
    """Write that a command failed before it found anything."""
    notification = {"level": "error", "message": {"text": text}}
    invocation = {"executionSuccessful": False, "toolExecutionNotifications": [notification]}
    driver = {"name": "rlctl", "version": __version__}
    log = make_log({"tool": {"driver": driver}, "invocations": [invocation], "results": []})
    files.write_result(path, (json.dumps(log, indent=2) + "\n").encode())
