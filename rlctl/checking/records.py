"""What the child processes have sent about one environment, and the two kinds of code that judge rules by it."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from rlctl.checking import messages
from rlctl.checking.finding import RULES, NotJudged, RuleFinding
from rlctl.checking.instance import Context

OTHERS_MATTER = ("interleaved", "interleaved second", "after close")  # judged by RL401 and RL402


@dataclasses.dataclass
class Records:
    """Everything known about one environment; what the checks of the parent process read."""

    task: str
    built: messages.Built | None = None
    trajectories: list[messages.CheckedEpisode] = dataclasses.field(default_factory=list)
    failures: list[messages.CallFailure] = dataclasses.field(default_factory=list)
    findings: list[RuleFinding] = dataclasses.field(default_factory=list)  # of the experiments
    facts: dict[str, Any] = dataclasses.field(default_factory=dict)  # by experiment
    skipped: dict[str, str] = dataclasses.field(default_factory=dict)  # experiment, role or rule -> reason
    not_applicable: dict[str, str] = dataclasses.field(default_factory=dict)  # rule -> reason
    finished: dict[str, messages.Finished] = dataclasses.field(default_factory=dict)  # by experiment
    normalizes: Callable[[str], bool] = lambda _: False  # says whether the recipe normalises `reward` or `observation`
    printed_lines: int = 0  # Lines that the environment of the first process wrote to stdout
    printed_first: str = ""

    def add(self, message: messages.ChildMessage) -> None:
        """Take in one message of a child process."""
        match message:
            case messages.Built():
                self.built = message
            case messages.CheckedEpisode():
                self.trajectories.append(message)
            case messages.CallFailure():
                self.failures.append(message)
            case RuleFinding():
                self.findings.append(message)
            case messages.Fact():
                self.facts[message.experiment] = message.value
            case messages.Skipped():
                (self.skipped if message.applies else self.not_applicable)[message.name] = message.reason
            case messages.Finished():
                self.finished[message.experiment] = message

    def role(self, role: str) -> list[messages.CheckedEpisode]:
        """Return what was recorded for one purpose."""
        return [trajectory for trajectory in self.trajectories if trajectory.role == role]

    @property
    def episodes(self) -> list[messages.CheckedEpisode]:
        """Return the whole episodes of the first process."""
        return self.role("episodes")

    def require_built(self) -> messages.Built:
        """Return the environment that was built; raises `NotJudged` if there is none."""
        if self.built is None:
            raise NotJudged("no instance could be built")
        return self.built

    @property
    def alone(self) -> list[messages.CheckedEpisode]:
        """Return all episodes of instances that were alone in their process and used as a learner uses them."""
        return [trajectory for trajectory in self.trajectories if trajectory.role not in OTHERS_MATTER]

    def require_alone(self) -> list[messages.CheckedEpisode]:
        """Return the same; raises `NotJudged` if there is none."""
        episodes = self.alone
        if not any(episode.steps or episode.observations for episode in episodes):
            raise NotJudged("no episode was recorded")
        return episodes

    def forms(self, what: str) -> list[tuple[messages.CheckedEpisode, messages.Form]]:
        """Return every type that something had in the same episodes."""
        return [(episode, form) for episode in self.require_alone() for form in episode.forms if form.what == what]

    def series(self, leaf: int) -> list[tuple[messages.CheckedEpisode, messages.Series]]:
        """Return the values of a leaf of the observation in the same episodes, where there are any."""
        episodes = [episode for episode in self.require_alone() if leaf in episode.observations]
        return [(episode, episode.observations[leaf]) for episode in episodes]

    def require_role(self, role: str) -> messages.CheckedEpisode:
        """Return the episode of a comparison; raises `NotJudged` if there is none."""
        episodes = self.role(role)
        if not episodes:
            raise NotJudged(f"the episode {role!r} could not be played")
        return episodes[0]

    def require_fact(self, experiment: str) -> Any:
        """Return what an experiment found out; raises `NotJudged` with the reason where it did not."""
        if experiment not in self.facts:
            raise NotJudged(self.why_missing(experiment))
        return self.facts[experiment]

    def require_whole(self, *experiments: str) -> None:
        """Raise `NotJudged` if the clock cut one of some experiments: what never happened may have happened later."""
        cut = [name for name in experiments if name in self.finished and self.finished[name].is_cut]
        if cut:
            raise NotJudged(self.skipped.get(cut[0], f"time ran out in the experiment {cut[0]!r}"))

    def why_missing(self, experiment: str) -> str:
        """Return why an experiment has not come to its end."""
        if experiment in self.skipped:
            return self.skipped[experiment]
        failed = [failure for failure in self.failures if failure.phase == experiment]
        if failed:
            return f"the environment failed in {failed[0].call} during this experiment: {failed[0].error}"
        return f"the process ended before the experiment {experiment!r}"


RECORDING = ("comparisons", "episodes", "instances")
"""The experiments that record episodes for all rules: with random and other actions, alone and beside another."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """One thing to do with an environment in a child process."""

    name: str
    run: Callable[[Context], Iterator[messages.ChildMessage]]  # yields findings at once, so that a crash loses none
    rules: tuple[str, ...]  # those it decides if it completes; may be empty
    share: float  # of the time of its process, relative to the others


@dataclasses.dataclass(frozen=True)
class Check:
    """How the parent process judges a rule from what was recorded."""

    rule: str
    run: Callable[[Records], Iterable[RuleFinding]]
    needs: tuple[str, ...]  # The experiments that record what it reads
    of_absence: bool = False  # it judges what never happened, so its experiments must be complete


def experiment(
    name: str, *rules: str, share: float = 1.0
) -> Callable[[Callable[[Context], Iterator[messages.ChildMessage]]], Experiment]:
    """Make an experiment of a function. It decides `rules`; see the package `families` for how."""

    def decorate(run: Callable[[Context], Iterator[messages.ChildMessage]]) -> Experiment:
        assert all(rule in RULES for rule in rules)
        return Experiment(name, run, rules, share)

    return decorate


def check(
    rule: str, *needs: str, of_absence: bool = False
) -> Callable[[Callable[[Records], Iterable[RuleFinding]]], Check]:
    """Make the check of a rule of a function; by default it reads the recorded episodes."""

    def decorate(run: Callable[[Records], Iterable[RuleFinding]]) -> Check:
        assert rule in RULES
        return Check(rule, run, needs or RECORDING, of_absence)

    return decorate
