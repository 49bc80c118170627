"""Which runs a word of the command line stands for."""

from __future__ import annotations

import glob
from pathlib import Path

from rlctl.errors import ArtifactError
from rlctl.run.directory import RunDirectory, is_group
from rlctl.run.group import find_group, read_group
from rlctl.run.lookup import find_run


def find_runs_of(text: str) -> list[RunDirectory]:
    """Return the runs that a word stands for: those of a glob, a group or a folder of runs, or one run."""
    if any(character in text for character in "*?[") and not Path(text).exists():
        runs = [RunDirectory(path) for path in map(Path, sorted(glob.glob(text))) if (path / "run.json").is_file()]
        if not runs:
            raise ArtifactError(f"{text}: no run matches")
        return runs
    path = Path(text)
    if not is_group(path) and (runs := [RunDirectory(file.parent) for file in sorted(path.glob("*/run.json"))]):
        return runs
    if (folder := find_group(text)) is None:
        return [find_run(text)]
    group = read_group(folder)
    runs = [run for seed in group.seeds if (run := group.find_run(seed)) is not None]
    if not runs:
        raise ArtifactError(f"{text}: none of its seeds has begun")
    return runs
