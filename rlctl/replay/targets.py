"""Where recordings go."""

from __future__ import annotations

from pathlib import Path

from rlctl.errors import UsageError
from rlctl.run.directory import RunDirectory


def check_output(output: Path | None, episodes: int) -> None:
    """Raise `UsageError` for an `--output` that cannot take this many episodes."""
    if output is None:
        return
    if output.suffix == ".rrd" and episodes > 1:
        raise UsageError(f"--output {output}: a recording has one episode; give a folder for {episodes}")
    if output.suffix == ".rrd" and output.is_dir():
        raise UsageError(f"--output {output}: a folder whose name ends in .rrd; give a name inside it")
    if output.suffix != ".rrd" and output.is_file():
        raise UsageError(f"--output {output}: give a folder, or the name of a recording, which ends in .rrd")


def recording_beside(episode: Path, output: Path | None) -> Path:
    """Return the recording of an episode file: beside it, unless `output` says otherwise."""
    if output is None:
        return episode.with_suffix(".rrd")
    return output if output.suffix == ".rrd" else output / episode.with_suffix(".rrd").name


def next_recording(output: Path | None, run: RunDirectory | None) -> Path:
    """Return the recording for a new episode.

    It is `output`, the next number in that folder, or the next number in `episodes/` of the run; of a policy
    without a run, in `episodes/` of the current folder.
    """
    if output is None:
        owner = run or RunDirectory(Path())
        return owner.episode_file(owner.next_episode_number()).with_suffix(".rrd")
    if output.suffix == ".rrd":
        return output
    numbers = [int(each.stem) for each in output.glob("*.rrd") if each.stem.isdecimal()]
    return output / RunDirectory(output).episode_file(max(numbers, default=-1) + 1).with_suffix(".rrd").name
