"""`rlctl replay`: rollouts of a policy, or a recorded episode, as recordings to look at."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Literal

from rlctl import output
from rlctl.environments.info import describe
from rlctl.environments.spec import UNCHANGED, EnvChanges, EnvSpec
from rlctl.errors import UsageError
from rlctl.evaluation.evaluate import LoadedPolicy, load_player
from rlctl.policy.numpy_policy import load_policy
from rlctl.replaying.film import check_file, film_episodes, make_filmable
from rlctl.replaying.recorder import Choose, Rollout, make_drawable, play_episode, recorded_actions
from rlctl.replaying.report import ReplayedEpisode, ReplayResult
from rlctl.replaying.reproduce import print_warning, record_episode, verify_episode
from rlctl.replaying.scene import Env
from rlctl.replaying.window import open_window, show_episodes
from rlctl.rollout.collect import play_episodes
from rlctl.rollout.messages import EpisodeResult
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.rollout.workers import Workers, available_cores
from rlctl.run.directory import RunDirectory
from rlctl.run.episode import RecordedEpisode, load_episode, save_episode
from rlctl.run.lookup import find_owner, find_policy, locate_task

_EPISODES_TO_CHOOSE_FROM = 100


@dataclasses.dataclass(frozen=True)
class Choice:
    """Episodes by outcome: by success where the task reports it, then by return."""

    kind: Literal["worst", "best", "failures"]
    count: int


def choose_episodes(
    policy: LoadedPolicy, spec: EnvSpec, episodes: int, seed: int, choice: Choice
) -> tuple[list[EpisodeResult], str]:
    """Play the episodes that `rlctl eval` plays and return those chosen, the most extreme first, and what they are.

    Raises `UsageError` for failures where the task reports no success.
    """
    seeds = episode_seeds(seed, Stream.EVAL, episodes)
    with Workers(spec, min(episodes, available_cores())) as workers:
        policy.give_to(workers)
        results = [episode.result for episode in play_episodes(workers, seeds)]
    chosen = select(results, choice)
    return chosen, f"{_describe_choice(results, choice.kind, len(chosen))} (seed {seed})"


def _describe_choice(results: Sequence[EpisodeResult], kind: str, count: int) -> str:
    episodes = output.format_count(len(results), "episode")
    if kind == "failures":
        failures = output.format_count(sum(not result.success for result in results), "failure")
        return f"{count} of {failures} among {episodes}" if count else f"nothing to replay: no failure among {episodes}"
    known = [result.success for result in results if result.success is not None]
    successes = f", of which {sum(known)} succeeded" if known else ""
    return f"the {f'{count} ' if count > 1 else ''}{kind} of {episodes}{successes}"


def select(results: Sequence[EpisodeResult], choice: Choice) -> list[EpisodeResult]:
    """Return the results of the chosen episodes, the most extreme first."""
    if choice.kind == "failures" and any(result.success is None for result in results):
        raise UsageError(f"--failures: this task reports no success; --worst {choice.count} goes by the return")
    left = [result for result in results if choice.kind != "failures" or not result.success]
    left.sort(key=lambda result: (bool(result.success), result.total_reward), reverse=choice.kind == "best")
    return left[: choice.count]


@dataclasses.dataclass(frozen=True)
class ReplayRequest:
    """What the command line asks for."""

    source: str | None
    episodes: int | None = None
    """None: one, or 100 to choose from."""
    seed: int = 0
    checkpoint: str = "best"
    task: str | None = None
    changes: EnvChanges = UNCHANGED
    verify: Path | None = None
    gui: bool = False
    output: Path | None = None
    video: Path | None = None
    """Write a film instead of recordings."""
    choice: Choice | None = None
    """Play `episodes` fast and replay those with certain outcomes."""
    sim: str | None = None
    """Another physics engine: `mujoco`, or `mujoco:SOLREF`."""

    @property
    def shown(self) -> int:
        """How many episodes are shown, at most."""
        return self.choice.count if self.choice else self.episodes or 1


def run_replay(request: ReplayRequest) -> ReplayResult:
    """Record, show or verify what was asked for.

    The actions of a recorded episode are replayed, and its recording goes beside it. With a policy new episodes are
    played, and each is written as an episode (`.npz`) and a recording (`.rrd`).
    """
    _check_request(request)
    output.results()  # from here on what an environment, or PyBullet's window, prints goes to stderr
    if request.verify is not None:
        return _verify(request.verify)
    played = _Recorded(Path(str(request.source)), request.output) if _is_episode(request.source) else _Actor(request)
    spec, seeds, film = played.spec, played.seeds, None
    if not seeds:
        episodes = []
    elif request.video is not None:
        with closing(make_filmable(spec)) as env:
            begin = functools.partial(played.begin, env)
            rollouts, film = film_episodes(request.video, env, spec, seeds, begin, policy=played.name)
        episodes = [_summarize(rollout) for rollout in rollouts]
    elif request.gui:
        with closing(open_window(spec)) as env:
            rollouts = show_episodes(env, spec, seeds, functools.partial(played.begin, env))
        episodes = [_summarize(rollout) for rollout in rollouts]
    else:
        episodes = played.record()
    return dataclasses.replace(played.report(episodes), film=film)


def _is_episode(source: str | None) -> bool:
    return source is not None and Path(source).suffix == ".npz"


def _check_request(request: ReplayRequest) -> None:
    source, target = request.source, request.output
    if source is not None and Path(source).suffix == ".rrd":
        raise UsageError(f"{source} is a recording already; open it with: rerun {source}")
    if request.verify is not None and (source is not None or request.gui or target is not None):
        raise UsageError("--verify replays one recorded episode and writes nothing: give only --verify EPISODE")
    if request.gui and target is not None:
        raise UsageError("--gui shows a window and writes nothing: leave out --output")
    recorded = request.verify or (source if _is_episode(source) else None)
    if recorded and request.checkpoint != "best":
        raise UsageError("a recorded episode is replayed as it was: leave out --checkpoint and --pretrained")
    if recorded and request.sim is not None:
        raise UsageError(f"--sim plays new episodes of a policy; {recorded} is a recorded one")
    if recorded and (request.task is not None or request.changes or request.episodes not in (None, 1)):
        raise UsageError("a recorded episode is replayed as it was: leave out --task, --set and --episodes")
    if recorded and (choice := request.choice) is not None:
        raise UsageError(f"--{choice.kind} chooses among the episodes of a policy; {recorded} is a recorded one")
    if request.video is not None:
        if request.gui or target is not None or request.verify is not None:
            raise UsageError("--video writes a film and nothing else: leave out --gui, --output and --verify")
        check_file(request.video)
    if target is None:
        return
    if target.suffix == ".rrd" and request.shown > 1:
        raise UsageError(f"--output {target}: a recording has one episode; give a folder for {request.shown}")
    if target.suffix == ".rrd" and target.is_dir():
        raise UsageError(f"--output {target}: a folder whose name ends in .rrd; give a name inside it")
    if target.suffix != ".rrd" and target.is_file():
        raise UsageError(f"--output {target}: give a folder, or the name of a recording, which ends in .rrd")


def _verify(path: Path) -> ReplayResult:
    episode = _load_episode(path)
    rollout, verification = verify_episode(episode, path)
    return ReplayResult(episode.info.spec.task, episode.info.policy, [_summarize(rollout)], verification)


def _load_episode(path: Path) -> RecordedEpisode:
    episode = load_episode(path)
    spec = dataclasses.replace(episode.info.spec, task=locate_task(episode.info.spec.task, find_owner(path)))
    return dataclasses.replace(episode, info=episode.info.model_copy(update={"spec": spec}))


class _Recorded:
    """A recorded episode, whose actions are replayed."""

    def __init__(self, path: Path, output: Path | None) -> None:
        self._path, self._output = path, output
        self._episode = _load_episode(path)
        info = self._episode.info
        self.spec, self.seeds, self.name = info.spec, [info.seed], info.policy

    def begin(self, env: Env, seed: int) -> Choose:
        return recorded_actions(self._episode, env, self._path)

    def record(self) -> list[ReplayedEpisode]:
        """Write the recording beside the episode, or to `--output`."""
        recording = self._path.with_suffix(".rrd")
        if self._output is not None:
            recording = self._output if self._output.suffix == ".rrd" else self._output / recording.name
        title = f"{self.spec.task} / episode {self._path.stem}"
        return [_summarize(record_episode(self._episode, recording, title=title), recording, self._path)]

    def report(self, episodes: list[ReplayedEpisode]) -> ReplayResult:
        return ReplayResult(self.spec.task, self.name, episodes)


class _Actor:
    """A policy and the environment it acts in."""

    def __init__(self, request: ReplayRequest) -> None:
        self._output = request.output
        found = find_policy(request.source, request.checkpoint)
        output.print_notes(found.notes)
        self._file, self._run = found.file, found.run
        self._policy = load_policy(self._file)
        info = self._policy.info
        self.spec: EnvSpec = found.locate(info.derive_spec(request.task, request.changes))
        if request.sim is not None:
            self.spec = dataclasses.replace(self.spec, sim=request.sim)
        self.name = f"{self._file.name}, {info.algo}, step {info.training_steps:,}"
        self._described = f"{self._file} ({info.algo}, step {info.training_steps:,})"
        self._chosen: dict[int, float] = {}
        """Returns of the chosen episodes, by seed."""
        self._choice = ""
        if request.choice is None:
            self.seeds = episode_seeds(request.seed, Stream.REPLAY, request.episodes or 1)
        else:
            episodes = request.episodes or _EPISODES_TO_CHOOSE_FROM
            player = load_player(self._file, deterministic=True)
            results, self._choice = choose_episodes(player, self.spec, episodes, request.seed, request.choice)
            self.seeds = [result.seed for result in results]
            self._chosen = {result.seed: result.total_reward for result in results}

    def record(self) -> list[ReplayedEpisode]:
        """Write each episode and its recording."""
        from rlctl.replaying.rrd import write_rrd

        spec, done = self.spec, []
        with closing(make_drawable(spec, print_warning)) as env:
            for seed in self.seeds:
                choose = self.begin(env, seed)
                rollout = play_episode(env, spec, seed, choose, policy=self.name, draw=print_warning)
                recording = self._next_recording()
                episode = recording.with_suffix(".npz")
                save_episode(episode, rollout.episode)
                title, several = f"{spec.task} / episode {recording.stem}", len(self.seeds) > 1
                write_rrd(recording, rollout, title=title, warn=print_warning, several=several)
                done.append(_summarize(rollout, recording, episode))
        return done

    def report(self, episodes: list[ReplayedEpisode]) -> ReplayResult:
        """Return the result; warns where an episode is not what it was when it was chosen."""
        for each in episodes:
            before = self._chosen.get(each.seed, each.total_reward)
            if before != each.total_reward:
                print_warning(
                    f"warning: seed {each.seed}: return {each.total_reward:.6g}, it was {before:.6g} when it was "
                    f"chosen; does the environment repeat itself? rlctl check-env {self.spec.task}"
                )
        return ReplayResult(self.spec.task, self.name, episodes, policy_file=self._described, choice=self._choice)

    def begin(self, env: Env, seed: int) -> Choose:
        self._policy.info.check_fits(describe(env), self._file)
        self._policy.reset()
        return lambda observation, step: self._policy.predict(observation)

    def _next_recording(self) -> Path:
        """Return `--output`, or the next number in that folder, in the run, or (without a run) in ./episodes."""
        if self._output is None:
            owner = self._run or RunDirectory(Path())
            return owner.episode_file(owner.next_episode_number()).with_suffix(".rrd")
        if self._output.suffix == ".rrd":
            return self._output
        numbers = [int(each.stem) for each in self._output.glob("*.*") if each.stem.isdecimal()]
        number = max(numbers, default=-1) + 1
        return self._output / RunDirectory(self._output).episode_file(number).with_suffix(".rrd").name


def _summarize(rollout: Rollout, recording: Path | None = None, episode: Path | None = None) -> ReplayedEpisode:
    info = rollout.episode.info
    return ReplayedEpisode(
        info.seed, rollout.length, info.total_reward, info.success, rollout.env.events, recording, episode
    )
