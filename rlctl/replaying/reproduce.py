"""Reproduces recorded episodes: compares them with the recorded values, or writes them as `.rrd`."""

from contextlib import closing
from pathlib import Path

from rlctl import output
from rlctl.errors import UsageError
from rlctl.replaying.difference import find_difference
from rlctl.replaying.recorder import (
    ONLY_OF_POLICIES,
    Rollout,
    check_actions,
    current_versions,
    make_drawable,
    play_episode,
    recorded_actions,
)
from rlctl.replaying.report import Verification
from rlctl.replaying.scene import Warn
from rlctl.rollout.workers import Workers
from rlctl.run.episode import RecordedEpisode


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
    from rlctl.replaying.rrd import write_rrd

    info, spec = episode.info, episode.info.spec
    if info.failure:
        replay_failed(episode)
    with closing(make_drawable(spec, warn)) as env:
        choose = recorded_actions(episode, env)
        rollout = play_episode(env, spec, info.seed, choose, policy=info.policy, draw=warn)
    if info.failure:
        warn(f"warning: {title}: it failed when it was recorded ({info.failure}), but did not fail now")
    elif difference := find_difference(episode, rollout):
        warn(f"warning: {title}: replayed, it differs from the recorded episode; {difference}")
    write_rrd(path, rollout, title=title, warn=warn, several=several)
    return rollout


def replay_failed(episode: RecordedEpisode) -> None:
    """Replay the actions of an episode that failed, in a worker: the episode may hang or end its process.

    Raises `TaskError` if it fails again.
    """
    with Workers(episode.info.spec, 1) as workers:
        check_actions(episode, workers.info.spaces()[1].shape or ())
        workers.replay_actions({0: (episode.info.seed, episode.actions)})


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
        rollout = play_episode(env, spec, info.seed, recorded_actions(episode, env, path), policy=info.policy)
    now = current_versions(spec.task)
    relevant = {name: version for name, version in info.versions.items() if name not in ONLY_OF_POLICIES}
    other = {name: (version, now.get(name)) for name, version in relevant.items() if now.get(name) != version}
    return rollout, Verification(path, find_difference(episode, rollout), other)
