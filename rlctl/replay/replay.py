"""`rlctl replay`: rollouts of a policy, or a recorded episode, as recordings to look at."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.errors import UsageError
from rlctl.replay.live import Lived, recorded_actions
from rlctl.replay.recording import record_episode, tell, verify_episode
from rlctl.replay.report import ReplayedEpisode, ReplayResult
from rlctl.replay.rollouts import Actor, load_actor
from rlctl.replay.targets import check_output, next_recording, recording_beside
from rlctl.replay.watching import watch, watched_env
from rlctl.replay.window import open_window, show_episodes
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.run import directory
from rlctl.run.episode import load_episode, save_episode


@dataclasses.dataclass(frozen=True)
class ReplayRequest:
    """What the command line asks for."""

    source: str | None
    episodes: int = 1
    seed: int = 0
    checkpoint: str = "best"
    task: str | None = None
    task_parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    verify: Path | None = None
    gui: bool = False
    output: Path | None = None


def run_replay(request: ReplayRequest) -> ReplayResult:
    """Record, show or verify what was asked for.

    A recorded episode is lived again, and its recording goes beside it. With a policy new episodes are lived, and
    each is written as an episode (`.npz`) and a recording (`.rrd`).
    """
    _check_request(request)
    output.results()  # from here on what an environment, or PyBullet's window, prints goes to stderr
    if request.verify is not None:
        return _verify(request.verify)
    if _is_episode(request.source):
        path = Path(str(request.source))
        return _show_episode(path) if request.gui else _record_episode(path, request.output)
    return _show_policy(request) if request.gui else _record_policy(request)


def _is_episode(source: str | None) -> bool:
    return source is not None and Path(source).suffix == ".npz"


def _check_request(request: ReplayRequest) -> None:
    source = request.source
    if source is not None and Path(source).suffix == ".rrd":
        raise UsageError(f"{source} is a recording already; open it with: rerun {source}")
    if request.verify is not None and (source is not None or request.gui or request.output is not None):
        raise UsageError("--verify lives one recorded episode again and writes nothing: give only --verify EPISODE")
    if request.gui and request.output is not None:
        raise UsageError("--gui shows a window and writes nothing: leave out --output")
    lived_before = request.verify is not None or _is_episode(source)
    if lived_before and (request.task is not None or request.task_parameters or request.episodes != 1):
        raise UsageError("a recorded episode is lived as it was: leave out --task, --set and --episodes")
    check_output(request.output, request.episodes)


def _verify(path: Path) -> ReplayResult:
    episode = load_episode(path)
    lived, verification = verify_episode(episode, path)
    return ReplayResult(episode.info.task, episode.info.policy, [_replayed(lived)], verification)


def _record_episode(path: Path, where: Path | None) -> ReplayResult:
    episode, target = load_episode(path), recording_beside(path, where)
    lived = record_episode(episode, target, title=f"{episode.info.task} / episode {path.stem}")
    return ReplayResult(episode.info.task, episode.info.policy, [_replayed(lived, target, path)])


def _show_episode(path: Path) -> ReplayResult:
    episode = load_episode(path)
    info, spec = episode.info, episode.info.env_spec()
    with open_window(spec) as env:
        actions = recorded_actions(episode, env, path)
        shown = show_episodes(env, spec, [info.seed], lambda: actions)
    return ReplayResult(info.task, info.policy, [_replayed(lived) for lived in shown])


def _actor(request: ReplayRequest) -> tuple[Actor, directory.RunDirectory | None]:
    file, run = directory.find_policy(request.source, request.checkpoint)
    return load_actor(file, request.task, request.task_parameters), run


def _show_policy(request: ReplayRequest) -> ReplayResult:
    actor, _ = _actor(request)
    seeds = episode_seeds(request.seed, Stream.REPLAY, request.episodes)
    with open_window(actor.spec) as env:
        actor.check_fits(env)
        shown = show_episodes(env, actor.spec, seeds, actor.episode)
    return ReplayResult(actor.spec.task, actor.name, [_replayed(lived) for lived in shown])


def _record_policy(request: ReplayRequest) -> ReplayResult:
    from rlctl.replay.rrd import write_rrd

    actor, run = _actor(request)
    done = []
    with watched_env(actor.spec, tell) as env:
        actor.check_fits(env)
        for seed in episode_seeds(request.seed, Stream.REPLAY, request.episodes):
            watched = watch(env, actor.spec, seed, actor.episode(), policy=actor.name, tell=tell)
            target = next_recording(request.output, run)
            episode = target.with_suffix(".npz")
            save_episode(episode, watched.lived.episode)
            write_rrd(target, watched, title=f"{actor.spec.task} / episode {target.stem}", tell=tell)
            done.append(_replayed(watched.lived, target, episode))
    return ReplayResult(actor.spec.task, actor.name, done)


def _replayed(lived: Lived, recording: Path | None = None, episode: Path | None = None) -> ReplayedEpisode:
    info = lived.episode.info
    return ReplayedEpisode(info.seed, lived.length, info.total_reward, info.success, recording, episode)
