"""Measures available memory, so that data that is too large is refused before it is allocated.

numpy and torch reserve memory without touching it: an allocation that is too large succeeds, and the system kills the
process later.
"""

import os
from pathlib import Path

_CGROUPS = Path("/sys/fs/cgroup")


def available() -> int | None:
    """Return how many bytes this process can still use, by machine and control groups; None if unknown."""
    limits = [value for value in (_read_machine(), *_read_control_groups()) if value is not None]
    return max(min(limits), 0) if limits else None


def _read_machine() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError):  # not Linux: only the installed memory is known
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return None


def _read_control_groups() -> list[int]:
    """Return the memory left in each control group (container, job); a group's limit includes its subgroups."""
    try:
        entries = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return []
    own = next((entry[3:] for entry in entries if entry.startswith("0::")), "/")
    folder = _CGROUPS / own.strip("/")
    groups = [group for group in (folder, *folder.parents) if group.is_relative_to(_CGROUPS)]
    limits = [_read_group(group, "memory.max", "memory.current", "file") for group in groups]
    limits.append(_read_group(_CGROUPS / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "cache"))
    return [value for value in limits if value is not None]


def _read_group(group: Path, limit: str, used: str, cache_name: str) -> int | None:
    try:
        ceiling = int((group / limit).read_text(encoding="ascii"))  # "max" without a limit
        taken = int((group / used).read_text(encoding="ascii"))
        rows = (group / "memory.stat").read_text(encoding="ascii").splitlines()
    except (OSError, ValueError):
        return None
    # The system counts cached files as used, but frees them when memory is short.
    cached = next((int(row.split()[1]) for row in rows if row.startswith(f"{cache_name} ")), 0)
    return ceiling - taken + cached
