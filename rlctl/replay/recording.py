"""Recorded episodes: lived again, compared with what was recorded, and written as `.rrd`."""

from __future__ import annotations

from pathlib import Path

from rlctl import output
from rlctl.errors import UsageError
from rlctl.replay.difference import find_difference
from rlctl.replay.live import Lived, check_actions, live, present_versions, recorded_actions
from rlctl.replay.report import Verification
from rlctl.replay.watching import Tell, watch, watched_env
from rlctl.rollout.workers import Workers
from rlctl.run.episode import RecordedEpisode


def tell(message: str) -> None:
    """Print a message to stderr."""
    output.err().print(message, markup=False)


def record_episode(episode: RecordedEpisode, path: Path, *, title: str, tell: Tell = tell) -> Lived:
    """Live a recorded episode again in an environment of its own and write what it looks like to `path`, an `.rrd`.

    `tell` hears if it went another way than recorded; the file is written all the same. Returns the new life. Raises
    `TaskError` for an episode that failed, and fails again.
    """
    from rlctl.replay.rrd import write_rrd

    info, spec = episode.info, episode.info.env_spec()
    if info.failure:
        live_failed(episode)
    with watched_env(spec, tell) as env:
        choose = recorded_actions(episode, env)
        watched = watch(env, spec, info.seed, choose, policy=info.policy, tell=tell)
    if info.failure:
        tell(f"warning: {title}: it failed when it was recorded ({info.failure}), and did not now")
    elif difference := find_difference(episode, watched.lived):
        tell(f"warning: {title}: lived again it is not what was recorded; {difference}")
    write_rrd(path, watched, title=title, tell=tell)
    return watched.lived


def live_failed(episode: RecordedEpisode) -> None:
    """Live an episode that failed again as a training does, in a worker: it may hang or end its process.

    Raises the `TaskError` that it failed with if it fails again.
    """
    with Workers(episode.info.env_spec(), 1) as workers:
        check_actions(episode, workers.arrays.action.shape[1:])
        workers.arrays.next_seed[:] = -1
        workers.reset({0: episode.info.seed})
        for action in episode.actions:
            workers.arrays.action[0] = action
            if workers.step():
                return


def verify_episode(episode: RecordedEpisode, path: Path) -> tuple[Lived, Verification]:
    """Live a recorded episode again in a fresh environment and compare every bit; `path` names it.

    Raises `UsageError` for an episode of which only the actions are known, because it failed.
    """
    if episode.info.failure:
        raise UsageError(
            f"{path}: the episode failed ({episode.info.failure}), so there is nothing to compare; "
            f"rlctl replay {path} lives its actions again"
        )
    info, spec = episode.info, episode.info.env_spec()
    env = spec.make()
    try:
        lived = live(env, spec, info.seed, recorded_actions(episode, env, path), policy=info.policy)
    finally:
        env.close()
    now = present_versions(info.task)
    other = {name: (version, now.get(name)) for name, version in info.versions.items() if now.get(name) != version}
    return lived, Verification(path, find_difference(episode, lived), other)
