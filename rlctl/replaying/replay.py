"""`rlctl replay`: rollouts of a policy, or a recorded episode, as recordings, films, or in a window."""

import dataclasses
import functools
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from rlctl import output
from rlctl.environments.info import describe
from rlctl.environments.spec import UNCHANGED, EnvSpec
from rlctl.errors import UsageError
from rlctl.evaluation.players import LoadedPolicy, load_player
from rlctl.policy.numpy_policy import load_policy
from rlctl.recipe.sources import parse_changes
from rlctl.replaying.pictures import check_file, film_episodes, open_window, show_episodes
from rlctl.replaying.recorder import Choose, Rollout, make_drawable, play_episode, recorded_actions
from rlctl.replaying.report import ReplayedEpisode, ReplayResult
from rlctl.replaying.reproduce import print_warning, record_episode, verify_episode
from rlctl.replaying.request import Choice, ReplayRequest
from rlctl.replaying.scene import Env
from rlctl.replaying.views import make_filmable
from rlctl.rollout.collect import play_episodes
from rlctl.rollout.messages import EpisodeResult
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.rollout.workers import Workers, available_cores
from rlctl.run.directory import RunDirectory, refuse_links_out
from rlctl.run.episode import RecordedEpisode, load_episode, save_episode
from rlctl.run.lookup import find_owner, find_policy, locate_task

_EPISODES_TO_CHOOSE_FROM = 100
_DEFAULTS = ReplayRequest()
_OF_POLICIES = {"checkpoint": "--checkpoint and --pretrained", "settings": "--set"} | {
    name: f"--{name}" for name in ("task", "episodes", "sim", "worst", "best", "failures")
}
"""The fields of a request that a recorded episode cannot have, and their options."""


def choose_episodes(
    policy: LoadedPolicy, spec: EnvSpec, episodes: int, seed: int, choice: Choice
) -> tuple[list[EpisodeResult], str]:
    """Play the episodes that `rlctl eval` plays; return the chosen ones, the worst or best first, and a description."""
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
    """Return the results of the chosen episodes, the worst or best first.

    Raises `UsageError` for failures where the task reports no success.
    """
    if choice.kind == "failures" and any(result.success is None for result in results):
        raise UsageError(
            f"--failures: this task reports no success; use --worst {choice.count}, which selects by return"
        )
    candidates = [result for result in results if choice.kind != "failures" or not result.success]
    candidates.sort(key=lambda result: (bool(result.success), result.total_reward), reverse=choice.kind == "best")
    return candidates[: choice.count]


def run_replay(request: ReplayRequest) -> ReplayResult:
    """Record, film, show or verify episodes.

    A recorded episode is replayed with its actions, and its recording (`.rrd`) is written next to it. A policy plays
    new episodes, and each is written as an episode (`.npz`) and a recording.
    """
    _check_request(request)
    output.results()  # from here on what an environment, or PyBullet's window, prints goes to stderr
    if request.verify is not None:
        recorded = _load_episode(request.verify)
        rollout, verification = verify_episode(recorded, request.verify)
        return ReplayResult(recorded.info.spec.task, recorded.info.policy, [_summarize(rollout)], verification)
    is_episode = _is_episode(request.source)
    source = _RecordedSource(Path(str(request.source)), request.output) if is_episode else _PolicySource(request)
    spec, seeds, film = source.spec, source.seeds, None
    rollouts: list[Rollout] = []
    if request.video is not None and seeds:
        with closing(make_filmable(spec)) as env:
            begin = functools.partial(source.begin, env)
            rollouts, film = film_episodes(request.video, env, spec, seeds, begin, policy=source.name)
    elif request.gui and seeds:
        with closing(open_window(spec)) as env:
            rollouts = show_episodes(env, spec, seeds, functools.partial(source.begin, env))
    elif seeds:
        return source.report(source.record())
    return dataclasses.replace(source.report([_summarize(rollout) for rollout in rollouts]), film=film)


def _is_episode(source: str | None) -> bool:
    return source is not None and Path(source).suffix == ".npz"


def _check_request(request: ReplayRequest) -> None:
    source, target = request.source, request.output
    if source is not None and Path(source).suffix == ".rrd":
        raise UsageError(f"{source} is a recording already; open it with: rerun {source}")
    for names in (("verify", "gui", "video", "output"), ("worst", "best", "failures")):
        if len(given := [f"--{name}" for name in names if getattr(request, name)]) > 1:
            raise UsageError(f"{given[0]} and {given[1]} exclude each other: leave out {given[1]}")
    if request.verify is not None and source is not None:
        raise UsageError(f"--verify replays only {request.verify}: leave out {source}")
    recorded = request.verify or (source if _is_episode(source) else None)
    asked = dataclasses.replace(request, episodes=None) if request.episodes == 1 else request  # it is one episode
    if recorded and (given := [name for name in _OF_POLICIES if getattr(asked, name) != getattr(_DEFAULTS, name)]):
        raise UsageError(
            f"{recorded} is a recorded episode and is replayed unchanged: leave out {_OF_POLICIES[given[0]]}"
        )
    if request.video is not None:
        check_file(request.video)
    if target is None:
        return
    count = request.choice.count if request.choice else request.episodes or 1
    if target.suffix == ".rrd" and count > 1:
        raise UsageError(f"--output {target}: a recording has one episode; give a folder for {count}")
    if target.suffix != ".rrd" and target.is_file():
        raise UsageError(f"--output {target}: give a folder, or the name of a recording, which ends in .rrd")


def _load_episode(path: Path) -> RecordedEpisode:
    episode = load_episode(path)
    spec = dataclasses.replace(episode.info.spec, task=locate_task(episode.info.spec.task, find_owner(path)))
    return dataclasses.replace(episode, info=episode.info.model_copy(update={"spec": spec}))


class _RecordedSource:
    def __init__(self, path: Path, output: Path | None) -> None:
        self._path, self._output = path, output
        self._episode = _load_episode(path)
        info = self._episode.info
        self.spec, self.seeds, self.name = info.spec, [info.seed], info.policy

    def begin(self, env: Env, seed: int) -> Choose:
        return recorded_actions(self._episode, env.action_space, self._path)

    def record(self) -> list[ReplayedEpisode]:
        """Write the recording next to the episode, or to `--output`."""
        recording = self._path.with_suffix(".rrd")
        if self._output is not None:
            recording = self._output if self._output.suffix == ".rrd" else self._output / recording.name
        title = f"{self.spec.task} / episode {self._path.stem}"
        return [_summarize(record_episode(self._episode, recording, title=title), recording, self._path)]

    def report(self, episodes: list[ReplayedEpisode]) -> ReplayResult:
        return ReplayResult(self.spec.task, self.name, episodes)


class _PolicySource:
    def __init__(self, request: ReplayRequest) -> None:
        self._output = request.output
        policy = find_policy(request.source, request.checkpoint)
        output.print_notes(policy.notes)
        self._file, self._run = policy.file, policy.run
        self._policy = load_policy(self._file)
        info = self._policy.info
        changes = parse_changes(request.settings) if request.settings else UNCHANGED
        if request.sim is not None:  # as `rlctl eval --sim`: without the recipe's events, which may be PyBullet's only
            changes = dataclasses.replace(changes, randomize=bool(changes.randomize))
        self.spec: EnvSpec = policy.locate(info.derive_spec(request.task, changes))
        if request.sim is not None:
            self.spec = dataclasses.replace(self.spec, sim=request.sim)
        self.name = f"{self._file.name}, {info.algo}, step {info.training_steps:,}"
        self._described = f"{self._file} ({info.algo}, step {info.training_steps:,})"
        self._chosen: dict[int, float] = {}  # returns of the chosen episodes, by seed
        self._choice = ""
        if request.choice is not None:
            episodes = request.episodes or _EPISODES_TO_CHOOSE_FROM
            player = load_player(self._file, deterministic=True)
            results, self._choice = choose_episodes(player, self.spec, episodes, request.seed, request.choice)
            self._chosen = {result.seed: result.total_reward for result in results}
            self.seeds = list(self._chosen)
        else:
            self.seeds = episode_seeds(request.seed, Stream.REPLAY, request.episodes or 1)

    def record(self) -> list[ReplayedEpisode]:
        """Write each episode and its recording."""
        from rlctl.replaying.rrd import write_rrd

        spec, episodes = self.spec, []
        with closing(make_drawable(spec)) as env:
            for seed in self.seeds:
                rollout = play_episode(env, spec, seed, self.begin(env, seed), policy=self.name, draw=print_warning)
                recording = self._next_recording()
                episode = recording.with_suffix(".npz")
                save_episode(episode, rollout.episode)
                title, several = f"{spec.task} / episode {recording.stem}", len(self.seeds) > 1
                write_rrd(recording, rollout, title=title, warn=print_warning, several=several)
                episodes.append(_summarize(rollout, recording, episode))
        return episodes

    def report(self, episodes: list[ReplayedEpisode]) -> ReplayResult:
        """Return the result; print a warning for an episode whose return has changed since it was chosen."""
        for episode in episodes:
            before = self._chosen.get(episode.seed, episode.total_reward)
            if before != episode.total_reward:
                returns = f"the return is {episode.total_reward:.6g}, but was {before:.6g} when the episode was chosen"
                advice = f"the environment may not be deterministic: rlctl check-env {self.spec.task}"
                print_warning(f"warning: seed {episode.seed}: {returns}; {advice}")
        return ReplayResult(self.spec.task, self.name, episodes, policy_file=self._described, choice=self._choice)

    def begin(self, env: Env, seed: int) -> Choose:
        self._policy.info.check_fits(describe(env), self._file)
        self._policy.reset()
        return lambda observation, step: self._policy.predict(observation)

    def _next_recording(self) -> Path:
        """Return `--output`, or the next number in that folder, in the run, or (without a run) in ./episodes."""
        if self._output is None:
            if self._run is not None:
                refuse_links_out(self._run.path)
            owner = self._run or RunDirectory(Path())
            return owner.episode_file(owner.next_episode_number()).with_suffix(".rrd")
        if self._output.suffix == ".rrd":
            return self._output
        numbers = [int(file.stem) for file in self._output.glob("*.*") if file.stem.isdecimal()]
        number = max(numbers, default=-1) + 1
        return self._output / RunDirectory(self._output).episode_file(number).with_suffix(".rrd").name


def _summarize(rollout: Rollout, recording: Path | None = None, episode: Path | None = None) -> ReplayedEpisode:
    info = rollout.episode.info
    outcome = info.seed, rollout.length, info.total_reward, info.success
    return ReplayedEpisode(*outcome, rollout.env.events, recording, episode)
