"""`rlctl replay`: rollouts of a policy, or a recorded episode, as recordings, films, or in a window."""

import dataclasses
import functools
from contextlib import closing
from pathlib import Path

from rlctl import output
from rlctl.errors import UsageError
from rlctl.replaying.camera import read_viewpoint
from rlctl.replaying.pictures import check_file, film_episodes, read_size
from rlctl.replaying.recorder import Rollout, join_watches
from rlctl.replaying.replay_request import ReplayRequest
from rlctl.replaying.report import ReplayedEpisode, ReplayResult
from rlctl.replaying.reproduce import print_warning, verify_episode
from rlctl.replaying.sources import PolicySource, RecordedSource, TaskSource, load_located, show_steps, summarize
from rlctl.replaying.views import make_filmable
from rlctl.replaying.window import open_window, show_episodes

_DEFAULTS = ReplayRequest()
_OF_POLICIES = {"checkpoint": "--checkpoint and --pretrained", "settings": "--set"} | {
    name: f"--{name}" for name in ("task", "episodes", "sim", "worst", "best", "failures")
}
"""The fields of a request that a recorded episode cannot have, and their options."""


def run_replay(request: ReplayRequest) -> ReplayResult:
    """Record, film, show or verify episodes.

    A recorded episode is replayed with its actions, and its recording (`.rrd`) is written next to it. A policy plays
    new episodes, and each is written as an episode (`.npz`) and a recording.
    """
    _check_request(request)
    output.results()  # from here on what an environment, or PyBullet's window, prints goes to stderr
    if request.verify is not None:
        recorded = load_located(request.verify)
        rollout, verification = verify_episode(recorded, request.verify)
        return ReplayResult(recorded.info.spec.task, recorded.info.policy, [summarize(rollout)], verification)
    viewpoint, size = read_viewpoint(request.camera), read_size(request.size)
    source = _choose_source(request)
    spec, seeds, film = source.spec, source.seeds, None
    episodes: list[ReplayedEpisode] = []
    if request.video is not None and seeds:
        draw, keep = None, _summarize
        if request.output is not None:
            draw, keep = print_warning, source.record_rollout
        with closing(make_filmable(spec)) as env, show_steps("filming", env, source) as show:
            begin = functools.partial(source.begin, env)
            episodes, film = film_episodes(
                request.video,
                env,
                spec,
                seeds,
                begin,
                policy=source.name,
                keep=keep,
                watch=join_watches(source.watch, show),
                viewpoint=viewpoint,
                size=size,
                draw=draw,
                at_s=request.at,
                longest_s=request.seconds,
            )
    elif request.gui and seeds:
        with closing(open_window(spec)) as env:
            rollouts = show_episodes(env, spec, seeds, functools.partial(source.begin, env), watch=source.watch)
        episodes = [summarize(rollout) for rollout in rollouts]
    elif seeds:
        return source.report(source.record())
    return dataclasses.replace(source.report(episodes), film=film)


def _summarize(number: int, rollout: Rollout) -> ReplayedEpisode:
    return summarize(rollout)


def _choose_source(request: ReplayRequest) -> RecordedSource | PolicySource | TaskSource:
    if request.baseline is not None:
        return TaskSource(request, request.baseline)
    if _is_episode(request.source):
        return RecordedSource(Path(str(request.source)), request.output)
    return PolicySource(request)


def _is_episode(source: str | None) -> bool:
    return source is not None and Path(source).suffix == ".npz"


def _check_request(request: ReplayRequest) -> None:
    source, target = request.source, request.output
    if source is not None and Path(source).suffix == ".rrd":
        raise UsageError(f"{source} is a recording already; open it with: rerun {source}")
    outputs = [("verify", "gui", "video"), ("verify", "gui", "output")]  # a film and recordings can be written at once
    for names in (*outputs, ("worst", "best", "failures")):
        if len(given := [f"--{name}" for name in names if getattr(request, name)]) > 1:
            raise UsageError(f"{given[0]} and {given[1]} exclude each other: leave out {given[1]}")
    for name in ("camera", "size", "at", "seconds"):
        if getattr(request, name) is not None and request.video is None:
            raise UsageError(f"--{name} is for films: add --video FILE.mp4")
    if request.verify is not None and source is not None:
        raise UsageError(f"--verify replays only {request.verify}: leave out {source}")
    if request.baseline is not None:
        _check_baseline(request, request.baseline)
    recorded = request.verify or (source if _is_episode(source) and request.baseline is None else None)
    asked = dataclasses.replace(request, episodes=None) if request.episodes == 1 else request  # it is one episode
    if recorded and (given := [name for name in _OF_POLICIES if getattr(asked, name) != getattr(_DEFAULTS, name)]):
        raise UsageError(
            f"{recorded} is a recorded episode and is replayed unchanged: leave out {_OF_POLICIES[given[0]]}"
        )
    if request.video is not None:
        check_file(request.video)
        _check_picture(request, request.video)
    if target is None:
        return
    count = request.choice.count if request.choice else request.episodes or 1
    if target.suffix == ".rrd" and count > 1:
        raise UsageError(f"--output {target}: a recording has one episode; give a folder for {count}")
    if target.suffix != ".rrd" and target.is_file():
        raise UsageError(f"--output {target}: give a folder, or the name of a recording, which ends in .rrd")


def _check_picture(request: ReplayRequest, video: Path) -> None:
    count = request.choice.count if request.choice else request.episodes or 1
    is_picture = video.suffix == ".png"
    if request.at is not None and not is_picture:
        raise UsageError("--at is for one picture: add --video FILE.png")
    if request.seconds is not None and is_picture:
        raise UsageError("--seconds is for films: add --video FILE.mp4, or --at SECONDS for a picture")
    if is_picture and (count or 1) > 1:
        raise UsageError(f"--video {video}: a picture is of one episode: leave out --episodes")


def _check_baseline(request: ReplayRequest, policy: str) -> None:
    if request.verify is not None:
        raise UsageError(f"--verify replays only {request.verify}: leave out --policy {policy}")
    given = [
        _OF_POLICIES[name] for name in ("checkpoint", "task") if getattr(request, name) != getattr(_DEFAULTS, name)
    ]
    if given:
        raise UsageError(f"--policy {policy} plays a task, not a run: leave out {given[0]}")
