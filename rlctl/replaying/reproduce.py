"""Reproduces recorded episodes: compares them bit for bit with the recorded values, or writes them as `.rrd`."""

import dataclasses
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl import output
from rlctl.environments.dict_spaces import Observations, split
from rlctl.errors import UsageError
from rlctl.play.episode import RecordedEpisode
from rlctl.play.workers import Workers
from rlctl.replaying.drawable import make_drawable
from rlctl.replaying.recorder import Rollout, current_versions, play_episode, recorded_actions
from rlctl.replaying.scene import Warn

_ONLY_OF_POLICIES = ("torch", "stable-baselines3", "sb3-contrib")
"""Packages that policies need, but recorded episodes, which contain the actions, do not."""


@dataclasses.dataclass(frozen=True)
class Difference:
    """Where a rollout begins to differ from the recorded episode."""

    step: int  # the first step that differs; 0 is the reset
    what: str
    recorded: str
    now: str
    size: float | None  # absolute difference there; None if it is not a finite number
    steps: int  # how many steps differ; 0 if only the end differs
    length: int  # steps of the recorded episode

    def __str__(self) -> str:
        by = "" if self.size is None else f" (off by {self.size:.3g})"
        many = f"; {self.steps} of {self.length + 1} steps differ" if self.steps else ""
        return f"step {self.step} of {self.length}: {self.what} is {self.now}, recorded {self.recorded}{by}{many}"


@dataclasses.dataclass(frozen=True)
class Verification:
    """How a recorded episode compares with a new rollout of its actions."""

    episode: Path
    difference: Difference | None
    other_versions: dict[str, tuple[str, str | None]]  # recorded and current version, by name, of those that differ


def print_warning(message: str) -> None:
    """Print a message to stderr."""
    output.err().print(message)


def record_episode(
    episode: RecordedEpisode, path: Path, *, title: str, warn: Warn = print_warning, several: bool = False
) -> Rollout:
    """Replay the actions of an episode in a new environment and write the recording to `path`, an `.rrd`.

    `warn` receives a difference from the recorded episode; the file is written nevertheless. `several`: it is opened
    together with others. Returns the new rollout. Raises `TaskError` for an episode that failed, and fails again.
    """
    info, spec = episode.info, episode.info.spec
    if info.failure:
        _replay_failed(episode)
    with closing(make_drawable(spec)) as env:
        choose = recorded_actions(episode, env.action_space)
        rollout = play_episode(env, spec, info.seed, choose, policy=info.policy, draw=warn)
    write_recording(episode, rollout, path, title=title, warn=warn, several=several)
    return rollout


def write_recording(
    episode: RecordedEpisode,
    rollout: Rollout,
    path: Path,
    *,
    title: str,
    warn: Warn = print_warning,
    several: bool = False,
) -> None:
    """Write the recording of a new rollout of an episode's actions; `warn` receives a difference from the episode."""
    from rlctl.replaying.rrd import write_rrd

    info = episode.info
    if info.failure:
        warn(f"warning: {title}: it failed when it was recorded ({info.failure}), but not when it was replayed")
    elif difference := find_difference(episode, rollout):
        warn(f"warning: {title}: the replayed episode differs from the recorded one; {difference}")
    write_rrd(path, rollout, title=title, warn=warn, several=several)


def _replay_failed(episode: RecordedEpisode) -> None:
    """Replay a failed episode in a worker, because it may hang or end its process; raises `TaskError` as it does."""
    with Workers(episode.info.spec, 1) as workers:
        recorded_actions(episode, workers.info.spaces()[1])
        workers.begin_episodes({0: (episode.info.seed, episode.actions)})


def verify_episode(episode: RecordedEpisode, path: Path) -> tuple[Rollout, Verification]:
    """Replay the actions of an episode in a new environment and compare every bit; errors mention `path`.

    Raises `UsageError` for an episode that failed, because it contains only actions.
    """
    info, spec = episode.info, episode.info.spec
    if info.failure:
        raise UsageError(
            f"{path}: the episode failed ({info.failure}), so there is nothing to compare; "
            f"to see it fail again: rlctl replay {path}"
        )
    with closing(spec.make()) as env:
        choose = recorded_actions(episode, env.action_space, path)
        rollout = play_episode(env, spec, info.seed, choose, policy=info.policy)
    now = current_versions(spec.task)
    relevant = {name: version for name, version in info.versions.items() if name not in _ONLY_OF_POLICIES}
    other = {name: (version, now.get(name)) for name, version in relevant.items() if now.get(name) != version}
    return rollout, Verification(path, find_difference(episode, rollout), other)


@dataclasses.dataclass(frozen=True)
class _Column:
    """Recorded and new values: a row per step from `first` on, a name per element of a row."""

    names: list[str]
    first: int
    recorded: NDArray[Any]
    now: NDArray[Any]

    def list_differing(self) -> list[int]:
        """Return the steps whose bits differ."""
        rows = min(len(self.recorded), len(self.now))
        before, after = self.recorded[:rows], self.now[:rows]
        if before.dtype != after.dtype or before.shape != after.shape:
            return list(range(self.first, self.first + rows))
        unequal: NDArray[np.bool_] = (_view_bits(before) != _view_bits(after)).any(axis=1)
        return (np.flatnonzero(unequal) + self.first).tolist()

    def describe(self, step: int) -> tuple[str, str, str, float | None]:
        """Return the first element that differs at a step: its name, recorded and new value, and by how much."""
        before, after = self.recorded[step - self.first], self.now[step - self.first]
        if before.dtype != after.dtype or before.shape != after.shape:
            types = [f"{values.size} x {values.dtype}" for values in (before, after)]
            return f"type of {self.names[0].partition('[')[0]}", types[0], types[1], None
        element = int(np.flatnonzero((_view_bits(before) != _view_bits(after)).any(axis=1))[0])
        recorded, now = before[element].item(), after[element].item()
        size = abs(float(now) - float(recorded))
        return self.names[element], repr(recorded), repr(now), size if np.isfinite(size) else None


def _view_bits(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the bytes of each row, or of each element of a single row."""
    return np.ascontiguousarray(values).reshape(len(values), -1).view(np.uint8)


def find_difference(recorded: RecordedEpisode, rollout: Rollout) -> Difference | None:
    """Compare observations, rewards, reward terms and the end; return None if all bits are equal."""
    length, columns = len(recorded.rewards), _list_columns(recorded, rollout)
    differing = [column.list_differing() for column in columns]
    steps = set().union(*differing)
    if not steps:
        return _find_different_end(recorded, rollout, length)
    first = min(steps)
    # If several columns differ in this step, report the first: a different observation explains a different reward.
    column = next(column for column, column_steps in zip(columns, differing, strict=True) if first in column_steps)
    return Difference(first, *column.describe(first), len(steps), length)


def _list_columns(recorded: RecordedEpisode, rollout: Rollout) -> list[_Column]:
    before, after = _flatten(recorded.observations), _flatten(rollout.episode.observations)
    columns = [
        _Column(_name_elements(name, max(part.shape[1], 1), rollout), 0, before.get(name, part[:, :0]), part)
        for name, part in after.items()
    ]
    columns.append(_Column(["reward"], 1, recorded.rewards[:, None], rollout.episode.rewards[:, None]))
    if (term_names := recorded.info.term_names) == rollout.episode.info.term_names and term_names:
        columns.append(_Column([f"term {name}" for name in term_names], 1, recorded.terms, rollout.episode.terms))
    return columns


def _flatten(observations: Observations) -> dict[str, NDArray[Any]]:
    return {name: values.reshape(len(values), -1) for name, values in split(observations).items()}


def _name_elements(name: str, count: int, rollout: Rollout) -> list[str]:
    sizes = rollout.env.observation_sizes
    if name or sum(sizes.values()) != count:
        sizes = {name: count}
    return [f"observation {part}".strip() + f"[{index}]" for part, size in sizes.items() for index in range(size)]


def _find_different_end(recorded: RecordedEpisode, rollout: Rollout, length: int) -> Difference | None:
    before, after = recorded.info, rollout.episode.info
    if rollout.length != length:
        missing = abs(length - rollout.length)
        return Difference(min(length, rollout.length), "length", str(length), str(rollout.length), missing, 0, length)
    for what, was, now in (
        ("end of the episode", "here", "here" if rollout.ended else "later"),
        ("names of the reward terms", before.term_names, after.term_names),
        ("success", before.success, after.success),
    ):
        if was != now:
            return Difference(length, what, str(was), str(now), None, 0, length)
    return None
