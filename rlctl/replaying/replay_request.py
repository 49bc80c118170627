"""The arguments of `rlctl replay` as data. Imports nothing that takes time."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from rlctl.options import Argument, Checkpoint, EpisodeSeed, Option, Settings, SimOption


@dataclasses.dataclass(frozen=True)
class Choice:
    """Which episodes to choose: by success if the task reports it, then by return."""

    kind: Literal["worst", "best", "failures"]
    count: int


@dataclasses.dataclass(frozen=True)
class ReplayRequest:
    """The arguments of `rlctl replay`."""

    source: Annotated[
        str | None,
        Argument(
            "A run or policy to roll out, a recorded episode (.npz), or with --policy a task.",
            metavar="[RUN or EPISODE or TASK]",
            completes="run",
            default_text="latest",
        ),
    ] = None
    baseline: Annotated[
        str | None,
        Option(
            "Play a TASK, before any training: zero, random, reference (its clip), FILE.py:FUNCTION, or a server.",
            ("--policy",),
            metavar="POLICY",
        ),
    ] = None
    episodes: Annotated[
        int | None,
        Option("Episodes to roll out, or to choose from.", min=1, max=1_000_000, default_text="1; 100 to choose from"),
    ] = None
    worst: Annotated[int | None, Option("Only the N worst of --episodes; 1 without N.", metavar="[N]", min=1)] = None
    best: Annotated[int | None, Option("Only the N best of --episodes.", metavar="[N]", min=1)] = None
    failures: Annotated[int | None, Option("Only the N worst failures of --episodes.", metavar="[N]", min=1)] = None
    seed: EpisodeSeed = 0
    checkpoint: Checkpoint = "best"
    task: Annotated[str | None, Option("Roll out on this task instead of the one it was trained on.")] = None
    settings: Settings = dataclasses.field(default_factory=list)
    verify: Annotated[Path | None, Option("Replay an episode; exit 1 if any bit differs.", metavar="EPISODE")] = None
    gui: Annotated[bool, Option("Show it in a window, live, instead of writing a recording.", ("--gui",))] = False
    sim: SimOption = None
    output: Annotated[
        Path | None,
        Option(
            "An .rrd file or a folder. Default: episodes/ of the run; with --policy ./TASK-POLICY.rrd.",
            ("--output", "-o"),
            metavar="PATH",
        ),
    ] = None
    video: Annotated[
        Path | None,
        Option("Write a film, .mp4 or .gif, or a picture, .png; recordings too only with --output.", metavar="FILE"),
    ] = None
    at: Annotated[
        float | None,
        Option("Of a .png: seconds after the start.", metavar="SECONDS", min=0, default_text="the middle"),
    ] = None
    seconds: Annotated[
        float | None,
        Option("Film only so much of each episode.", metavar="SECONDS", min=0.1, default_text="all"),
    ] = None
    size: Annotated[
        str | None,
        Option("Size of the film in pixels.", metavar="WIDTHxHEIGHT", default_text="640x480; of a .gif 400x300"),
    ] = None
    camera: Annotated[
        str | None,
        Option(
            "Where the film's camera is: degrees from the x axis, degrees up, times nearer.",
            metavar="AZIMUTH[,ELEVATION[,ZOOM]]",
            default_text="-42,22,1",
        ),
    ] = None

    @property
    def choice(self) -> Choice | None:
        """Which episodes to choose by their outcome."""
        counts: dict[Literal["worst", "best", "failures"], int | None]
        counts = {"worst": self.worst, "best": self.best, "failures": self.failures}
        return next((Choice(kind, count) for kind, count in counts.items() if count is not None), None)
