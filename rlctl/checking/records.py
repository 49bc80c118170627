"""Everything that is known about one environment: what the child processes have sent. No environment code runs here."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from rlctl.checking.finding import NotJudged, RuleFinding
from rlctl.checking.messages import (
    Built,
    CallFailure,
    CheckedEpisode,
    ChildMessage,
    Fact,
    Finished,
    Form,
    Series,
    Skipped,
)

OTHERS_MATTER = ("interleaved", "interleaved second", "after close")
"""Roles of episodes beside another instance: rules of their own judge them."""


@dataclasses.dataclass
class Records:
    """Everything known about one environment; what the checks of the parent process read."""

    task: str
    built: Built | None = None
    trajectories: list[CheckedEpisode] = dataclasses.field(default_factory=list)
    failures: list[CallFailure] = dataclasses.field(default_factory=list)
    findings: list[RuleFinding] = dataclasses.field(default_factory=list)
    """Those of the experiments."""
    facts: dict[str, Any] = dataclasses.field(default_factory=dict)
    """By the name of the experiment that found it out."""
    skipped: dict[str, str] = dataclasses.field(default_factory=dict)
    """Experiments, roles and rules that were left out, and why."""
    not_applicable: dict[str, str] = dataclasses.field(default_factory=dict)
    """Rules that an experiment found nothing to look at for, and why."""
    finished: dict[str, Finished] = dataclasses.field(default_factory=dict)
    """Per experiment that was run and did not end its process."""
    normalizes: Callable[[str], bool] = lambda _: False
    """Says whether there is a packaged recipe, and it normalises the `reward`, or the `observation`."""
    printed_lines: int = 0
    """Lines that the environment of the first process wrote to stdout."""
    printed_first: str = ""

    def add(self, message: ChildMessage) -> None:
        """Take in one message of a child process."""
        match message:
            case Built():
                self.built = message
            case CheckedEpisode():
                self.trajectories.append(message)
            case CallFailure():
                self.failures.append(message)
            case RuleFinding():
                self.findings.append(message)
            case Fact():
                self.facts[message.experiment] = message.value
            case Skipped():
                (self.skipped if message.applies else self.not_applicable)[message.name] = message.reason
            case Finished():
                self.finished[message.experiment] = message

    def role(self, role: str) -> list[CheckedEpisode]:
        """Return what was recorded for one purpose."""
        return [trajectory for trajectory in self.trajectories if trajectory.role == role]

    @property
    def episodes(self) -> list[CheckedEpisode]:
        """Return the whole episodes of the first process."""
        return self.role("episodes")

    def require_built(self) -> Built:
        """Return the environment that was built; raises `NotJudged` if there is none."""
        if self.built is None:
            raise NotJudged("no instance could be built")
        return self.built

    @property
    def alone(self) -> list[CheckedEpisode]:
        """Return all episodes of instances that were alone in their process and used as a learner uses them."""
        return [trajectory for trajectory in self.trajectories if trajectory.role not in OTHERS_MATTER]

    def require_alone(self) -> list[CheckedEpisode]:
        """Return the same; raises `NotJudged` if there is none."""
        episodes = self.alone
        if not any(episode.steps or episode.observations for episode in episodes):
            raise NotJudged("no episode was recorded")
        return episodes

    def forms(self, what: str) -> list[tuple[CheckedEpisode, Form]]:
        """Return every type that something had in the same episodes."""
        return [(episode, form) for episode in self.require_alone() for form in episode.forms if form.what == what]

    def series(self, leaf: int) -> list[tuple[CheckedEpisode, Series]]:
        """Return the values of a leaf of the observation in the same episodes, where there are any."""
        return [
            (episode, episode.observations[leaf]) for episode in self.require_alone() if leaf in episode.observations
        ]

    def require_role(self, role: str) -> CheckedEpisode:
        """Return the episode of a comparison; raises `NotJudged` if there is none."""
        episodes = self.role(role)
        if not episodes:
            raise NotJudged(self.skipped.get(role, f"the comparison {role!r} could not be made"))
        return episodes[0]

    def require_fact(self, experiment: str) -> Any:
        """Return what an experiment found out; raises `NotJudged` with the reason where it did not."""
        if experiment not in self.facts:
            raise NotJudged(self.why_missing(experiment))
        return self.facts[experiment]

    def why_missing(self, experiment: str) -> str:
        """Return why an experiment has not come to its end."""
        if experiment in self.skipped:
            return self.skipped[experiment]
        failed = [failure for failure in self.failures if failure.phase == experiment]
        if failed:
            return f"the environment failed in {failed[0].call} during this experiment: {failed[0].error}"
        return f"the process ended before the experiment {experiment!r}"
