"""The result of a replay, as text and JSON."""

import dataclasses
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.errors import AnswerIsNo
from rlctl.replaying.look import WorldSummary
from rlctl.replaying.look_table import show_world
from rlctl.replaying.reproduce import Verification
from rlctl.task.events.event import describe_randomization
from rlctl.version import collect_versions


@dataclasses.dataclass(frozen=True)
class ReplayedEpisode:
    """One episode that was played."""

    seed: int
    length: int
    total_reward: float
    success: bool | None
    events: Mapping[str, bool]  # the events that the task offers, and whether each acted
    recording: Path | None = None  # the `.rrd` file
    episode: Path | None = None  # the `.npz` file


@dataclasses.dataclass(frozen=True)
class FilmReport:
    """A film that was written."""

    file: Path
    pictures: int  # in the file, with those that show the end of each episode for a moment
    width: int
    height: int
    rate: float  # pictures per second, as it plays
    drawn_per_s: float  # pictures per second, as they were drawn


@dataclasses.dataclass(frozen=True)
class ReplayResult:
    """Episodes that were played, and the verification of one."""

    task: str
    policy: str
    episodes: list[ReplayedEpisode]
    verification: Verification | None = None
    policy_file: str = ""  # path and description of the policy; empty for a recorded episode
    choice: str = ""  # how the episodes were chosen by outcome; empty if they were not
    film: FilmReport | None = None
    world: WorldSummary | None = None  # of the first episode of a named policy, where it can be read

    def check(self) -> None:
        """Raise `AnswerIsNo` if a recorded episode could not be reproduced."""
        if self.verification is not None and self.verification.difference is not None:
            raise AnswerIsNo(f"{self.verification.episode}: not identical, {self.verification.difference}")


def show(result: ReplayResult, json: str | None) -> None:
    """Print the episodes and the command that opens them, or write them as JSON."""
    if output.present(as_json(result), json):
        return
    if result.verification is not None:
        _show_verification(result, result.verification)
        return
    out = output.out()
    randomization = describe_randomization(result.episodes[0].events) if result.episodes else ""
    parts = ", ".join(part for part in (result.policy_file or result.policy, randomization) if part)
    out.print(f"{result.task}: {parts}" if parts else result.task)
    if result.choice:
        out.print(result.choice)
    if result.world is not None:
        show_world(result.world)
    for episode in result.episodes:
        out.print(_format_episode(episode))
    if film := result.film:
        if film.file.suffix == ".png":
            out.print(f"{film.file}: a picture of {film.width}x{film.height}")
        else:
            pictures = f"{film.pictures} pictures of {film.width}x{film.height}, {film.rate:.3g} per second"
            out.print(f"{film.file}: {pictures}; drawn at {film.drawn_per_s:.3g} per second")
    if command := open_command(result):
        out.print(f"open with: {command}")
        out.print(f"without a display, in a browser: {command.replace('rerun', 'rerun --serve-web', 1)}")


def _format_episode(episode: ReplayedEpisode) -> str:
    file = f"{episode.recording}: " if episode.recording else ""
    success = ""
    if episode.success is not None:
        success = ", success" if episode.success else ", no success"
    return f"{file}seed {episode.seed}, {episode.length} steps, return {episode.total_reward:.4g}{success}"


def _show_verification(result: ReplayResult, verification: Verification) -> None:
    out, (episode,) = output.out(), result.episodes
    verdict = "identical, bit for bit" if verification.difference is None else "not identical"
    out.print(f"{verification.episode}: {result.task}, {_format_episode(episode)}: {verdict}")
    for name, (recorded, now) in verification.other_versions.items():
        out.print(f"recorded with {name} {recorded}, now {now or 'not installed'}")


def open_command(result: ReplayResult) -> str | None:
    """Return the command that opens the recordings; None if there are none."""
    files = [str(episode.recording) for episode in result.episodes if episode.recording]
    return shlex.join(["rerun", *files]) if files else None


def as_json(result: ReplayResult) -> dict[str, Any]:
    """Return the result as plain data for JSON."""
    content: dict[str, Any] = {
        "task": result.task,
        "policy": result.policy,
        "episodes": [
            {
                "file": episode.recording,
                "return": episode.total_reward,
                "randomized": any(episode.events.values()),
                **{name: getattr(episode, name) for name in ("episode", "seed", "length", "success", "events")},
            }
            for episode in result.episodes
        ],
        "open": open_command(result),
        "versions": collect_versions(),
    }
    content |= {name: value for name in ("choice", "film") if (value := getattr(result, name))}
    if result.world is not None:
        content["world"] = result.world.as_json()
    if (verification := result.verification) is not None:
        versions = verification.other_versions.items()
        content["verification"] = {
            "episode": verification.episode,
            "identical": verification.difference is None,
            "difference": verification.difference,
            "other_versions": {name: {"recorded": recorded, "now": now} for name, (recorded, now) in versions},
        }
    return content
