"""Recordings of episodes that were lived before: lived again, compared, and written as `.rrd`."""

from __future__ import annotations

from pathlib import Path

from rlctl import output
from rlctl.replay.difference import Difference, find_difference
from rlctl.replay.live import Env, Lived, recorded_actions
from rlctl.replay.watching import Tell, Watched, watch, watched_env
from rlctl.run.episode import RecordedEpisode


def tell(message: str) -> None:
    """Print a message to stderr."""
    output.err().print(message, markup=False)


def record_episode(episode: RecordedEpisode, path: Path, *, title: str, tell: Tell = tell) -> Difference | None:
    """Live a recorded episode again in an environment of its own and write what it looks like to `path`, an `.rrd`.

    Returns where it went another way than recorded, and tells it; the file is written all the same.
    """
    from rlctl.replay.rrd import write_rrd

    with watched_env(episode.info.env_spec(), tell) as env:
        watched = watch_again(env, episode, tell=tell)
    difference = find_difference(episode, watched.lived)
    if difference is not None:
        tell(f"warning: {title}: lived again it differs from what was recorded, {difference}")
    write_rrd(path, watched, title=title, tell=tell)
    return difference


def watch_again(env: Env, episode: RecordedEpisode, *, tell: Tell = tell) -> Watched:
    """Live the seed and the actions of an episode again."""
    info = episode.info
    choose = recorded_actions(episode, env)
    return watch(env, info.env_spec(), info.seed, choose, policy=info.policy, tell=tell)


def write_watched(path: Path, watched: Watched, *, title: str) -> Lived:
    """Write a recording of an episode that was just lived, and return the episode."""
    from rlctl.replay.rrd import write_rrd

    write_rrd(path, watched, title=title, tell=tell)
    return watched.lived
