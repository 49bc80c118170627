"""The version of a task: that of its distribution, and the sha256 of its source."""

import subprocess
from collections.abc import Mapping
from typing import Any

from rlctl.environments import registry
from rlctl.storage import files


def identify_task(task: str) -> dict[str, Any]:
    """Return `origin` (distribution and version of an installed task) and `source_sha256` of the task's file."""
    source = registry.find_source_file(task)
    digest = files.digest(source.read_bytes()) if source is not None and source.is_file() else None
    return {"origin": registry.find_origin(task), "source_sha256": digest}


def describe_task_changes(before: Mapping[str, Any], task: str, since: str = "the run began") -> list[str]:
    """Describe how a task differs from an earlier result of `identify_task`; empty if it does not."""
    now = identify_task(task)
    earlier, later = (origin if isinstance(origin, dict) else {} for origin in (before.get("origin"), now["origin"]))
    if earlier != later:
        names = (" ".join(map(str, origin.values())) or "no installed package" for origin in (earlier, later))
        return ["task {} came from {} when {since}, and comes from {} now".format(task, *names, since=since)]
    if before.get("source_sha256") != now["source_sha256"]:
        file = registry.find_source_file(task)
        gone = file is not None and not file.is_file()
        return [f"{file or task} {'no longer exists' if gone else f'has changed since {since}'}"]
    return []


def find_git_commit() -> str | None:
    """Return the commit of the current folder's repository; None outside of one."""
    try:
        result = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5.0, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() or None
