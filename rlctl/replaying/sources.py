"""Where the episodes of a replay come from: a recorded episode, the policy of a run, or a task and a named policy."""

import contextlib
import dataclasses
import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from rlctl import output
from rlctl.environments.bullet_clients import find_clients
from rlctl.environments.info import describe
from rlctl.environments.registry import make_slug
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.evaluation.players import Baseline, LoadedPolicy, choose_task, load_baseline, load_player
from rlctl.play.episode import RecordedEpisode, load_episode, save_episode, save_next_episode
from rlctl.play.seeds import Stream, episode_seeds
from rlctl.policy.actor import Actor, Rows, as_rows
from rlctl.policy.load import load_policy
from rlctl.policy.named_actors import SERVER
from rlctl.recipe.sources import parse_changes
from rlctl.replaying.choice import choose_episodes
from rlctl.replaying.drawable import make_drawable
from rlctl.replaying.look import WorldWatch
from rlctl.replaying.look_readers import make_world_reader
from rlctl.replaying.recorder import (
    Choose,
    Rollout,
    Watch,
    count_steps,
    find_dt,
    join_watches,
    play_episode,
    recorded_actions,
)
from rlctl.replaying.reference import REFERENCE, check_has_reference, show_reference
from rlctl.replaying.replay_request import ReplayRequest
from rlctl.replaying.report import ReplayedEpisode, ReplayResult
from rlctl.replaying.reproduce import print_warning, record_episode, write_recording
from rlctl.replaying.scene import Env
from rlctl.runs.directory import RunDirectory, refuse_links_out
from rlctl.runs.lookup import find_owner, find_policy, locate_task

_EPISODES_TO_CHOOSE_FROM = 100
_ROUNDING = 1e-9  # relative; sums of equal rewards in another order
_LONGEST = 1000  # [steps], of an episode without a known time limit


class RecordedSource:
    """A recorded episode."""

    def __init__(self, path: Path, output: Path | None) -> None:
        self._path, self._output = path, output
        self._episode = load_located(path)
        info = self._episode.info
        self.spec, self.seeds, self.name = info.spec, [info.seed], info.policy
        self.most_steps: int | None = len(self._episode.actions)

    def begin(self, env: Env, seed: int) -> Choose:
        """Return a function that chooses the recorded actions."""
        return recorded_actions(self._episode, env.action_space, self._path)

    def watch(self, step: int) -> None:
        """Do nothing after a step."""

    def record(self) -> list[ReplayedEpisode]:
        """Write the recording next to the episode, or to `--output`."""
        recording = self._find_recording()
        with output.show_progress("recording"):
            rollout = record_episode(self._episode, recording, title=self._title)
        return [summarize(rollout, recording, self._path)]

    def record_rollout(self, number: int, rollout: Rollout) -> ReplayedEpisode:
        """Write the recording of a rollout that was played already."""
        recording = self._find_recording()
        write_recording(self._episode, rollout, recording, title=self._title)
        return summarize(rollout, recording, self._path)

    @property
    def _title(self) -> str:
        return f"{self.spec.task} / episode {self._path.stem}"

    def _find_recording(self) -> Path:
        recording = self._path.with_suffix(".rrd")
        if self._output is None:
            return recording
        return self._output if self._output.suffix == ".rrd" else self._output / recording.name

    def report(self, episodes: list[ReplayedEpisode]) -> ReplayResult:
        """Return the result."""
        return ReplayResult(self.spec.task, self.name, episodes)


class _NewEpisodes:
    """New episodes of a policy, chosen by their outcome or by their seeds."""

    name: str  # of the policy, in the recording
    described: str  # the policy, for the result
    most_steps: int | None = None  # of an episode; None: as the environment says

    def __init__(self, request: ReplayRequest, spec: EnvSpec, player: LoadedPolicy | Baseline) -> None:
        self._output, self.spec = request.output, spec
        self._chosen: dict[int, float] = {}  # returns of the chosen episodes, by seed
        self._choice = ""
        if request.choice is not None:
            episodes = request.episodes or _EPISODES_TO_CHOOSE_FROM
            results, self._choice = choose_episodes(player, self.spec, episodes, request.seed, request.choice)
            self._chosen = {result.seed: result.total_reward for result in results}
            self.seeds = list(self._chosen)
        else:
            self.seeds = episode_seeds(request.seed, Stream.REPLAY, request.episodes or 1)

    def begin(self, env: Env, seed: int) -> Choose:
        """Return the function that chooses the actions of an episode."""
        raise NotImplementedError

    def watch(self, step: int) -> None:
        """Look at the world after a step."""

    def record(self) -> list[ReplayedEpisode]:
        """Write each episode and its recording."""
        spec, episodes = self.spec, []
        with closing(make_drawable(spec)) as env, show_steps("recording", env, self) as show:
            watch = join_watches(self.watch, show)
            for number, seed in enumerate(self.seeds):
                choose = self.begin(env, seed)
                rollout = play_episode(env, spec, seed, choose, policy=self.name, draw=print_warning, watch=watch)
                episodes.append(self.record_rollout(number, rollout))
        return episodes

    def record_rollout(self, number: int, rollout: Rollout) -> ReplayedEpisode:
        """Write an episode that was played, and its recording."""
        from rlctl.replaying.rrd import write_rrd

        episode = self.save(number, rollout.episode)
        recording = episode.with_suffix(".rrd")
        title, several = f"{self.spec.task} / episode {recording.stem}", len(self.seeds) > 1
        write_rrd(recording, rollout, title=title, warn=print_warning, several=several)
        return summarize(rollout, recording, episode)

    def report(self, episodes: list[ReplayedEpisode]) -> ReplayResult:
        """Return the result; print a warning for an episode whose return has changed since it was chosen."""
        for episode in episodes:
            before = self._chosen.get(episode.seed, episode.total_reward)
            if not math.isclose(before, episode.total_reward, rel_tol=_ROUNDING, abs_tol=_ROUNDING):
                off = f"{episode.total_reward - before:+.3g} off"
                returns = f"the return is {episode.total_reward:.6g}, {off} from when the episode was chosen"
                advice = f"the environment may not be deterministic: rlctl check-env {self.spec.task}"
                print_warning(f"warning: seed {episode.seed}: {returns}; {advice}")
        return ReplayResult(self.spec.task, self.name, episodes, policy_file=self.described, choice=self._choice)

    def save(self, number: int, episode: RecordedEpisode) -> Path:
        """Write an episode as `--output`, or under the next number in that folder, or in the default place.

        Return its file; the recording next to it has the same name.
        """
        if self._output is None:
            return self._save_by_default(number, episode)
        if self._output.suffix != ".rrd":
            return save_next_episode(self._output, episode)
        file = self._output.with_suffix(".npz")
        save_episode(file, episode)
        return file

    def _save_by_default(self, number: int, episode: RecordedEpisode) -> Path:
        raise NotImplementedError


class PolicySource(_NewEpisodes):
    """New episodes of the policy of a run, or of a policy file."""

    def __init__(self, request: ReplayRequest) -> None:
        policy = find_policy(request.source, request.checkpoint)
        output.print_notes(policy.notes)
        self._file, self._run = policy.file, policy.run
        self._policy = load_policy(self._file)
        info = self._policy.info
        spec = policy.locate(info.derive_spec(request.task, parse_changes(request.settings, request.sim)))
        self.name = f"{self._file.name}, {info.algo}, step {info.training_steps:,}"
        self.described = f"{self._file} ({info.algo}, step {info.training_steps:,})"
        super().__init__(request, spec, load_player(self._file, deterministic=True))

    def begin(self, env: Env, seed: int) -> Choose:
        """Return the function that chooses the actions of an episode."""
        self._policy.info.check_fits(describe(env), self._file)
        self._policy.reset()
        return lambda observation, step: self._policy.predict(observation)

    def _save_by_default(self, number: int, episode: RecordedEpisode) -> Path:
        """Write an episode under the next number in the run, or (without a run) in ./episodes."""
        if self._run is not None:
            refuse_links_out(self._run.path)
        owner = self._run or RunDirectory(Path())
        return save_next_episode(owner.episodes, episode)


class TaskSource(_NewEpisodes):
    """Episodes of a task with zero or random actions, or a user's function; the world of the first is summarised.

    Of a task that follows a clip, the policy `reference` shows the clip: bodies are placed after every step. Nobody can
    play these episodes again, so only their recordings are written.
    """

    def __init__(self, request: ReplayRequest, policy: str) -> None:
        spec = choose_task(request.source, policy, "replay")
        self._is_reference = policy == REFERENCE
        if self._is_reference:
            _check_reference(request)
            check_has_reference(spec)
            spec = spec.as_deployed()
        spec = parse_changes(request.settings, request.sim).apply(spec)
        self._baseline = Baseline("zero") if self._is_reference else load_baseline(policy)
        self.name = self.described = REFERENCE if self._is_reference else self._baseline.title
        self._other_clients = find_clients()
        self._actor: Actor | None = None
        self._world: WorldWatch | None = None
        super().__init__(request, spec, self._baseline)

    def begin(self, env: Env, seed: int) -> Choose:
        """Return the function that chooses the actions of an episode."""
        self._env, self._seed = env, seed
        if self._is_reference:
            show_reference(env)
        actor = self._actor = self._actor or self._baseline.make_actor(env)
        actor.begin(Rows.one(seed))
        longest = _LONGEST if describe(env).max_steps is None else None

        def choose(observation: object, step: int) -> object:
            if step == longest:
                print_warning(f"seed {seed}: cut after {_LONGEST:,} steps, because no time limit is known")
                return None
            return actor.act(as_rows(observation), Rows.one(seed, step))[1][0]

        return choose

    def watch(self, step: int) -> None:
        """Read the world of the first episode after a step."""
        if self._seed != self.seeds[0]:
            return
        if step == 0 and (reader := make_world_reader(self._env, self._other_clients)) is not None:
            self._world = WorldWatch(reader, self._seed, find_dt(self._env))
        if self._world is not None:
            self._world.read(step)

    def report(self, episodes: list[ReplayedEpisode]) -> ReplayResult:
        """Return the result, with what was seen of the world."""
        result = super().report(episodes)
        if self._actor is not None:
            self._actor.close()
        if self._world is None:
            if episodes:
                output.print_notes(["bodies and joints are unknown: it simulates with neither PyBullet nor MuJoCo"])
            return result
        return dataclasses.replace(result, world=self._world.summarize())

    def record_rollout(self, number: int, rollout: Rollout) -> ReplayedEpisode:
        """Write the recording, and the episode unless it shows a clip."""
        if not self._is_reference:
            return super().record_rollout(number, rollout)
        from rlctl.replaying.rrd import write_rrd

        recording = self._output or self._find_default(number).with_suffix(".rrd")
        if recording.suffix != ".rrd":
            recording /= self._find_default(number).with_suffix(".rrd").name
        write_rrd(recording, rollout, title=f"{self.spec.task} / {REFERENCE}", warn=print_warning)
        return summarize(rollout, recording)

    def _save_by_default(self, number: int, episode: RecordedEpisode) -> Path:
        """Write `./TASK-POLICY.npz`, which the next look replaces; `-2`, `-3` for further episodes."""
        file = self._find_default(number)
        save_episode(file, episode)
        return file

    def _find_default(self, number: int) -> Path:
        policy = "server" if self.name.startswith(SERVER) else make_slug(self.name)
        count = f"-{number + 1}" if number else ""
        return Path(f"{make_slug(self.spec.task)}-{policy}{count}.npz")


def _check_reference(request: ReplayRequest) -> None:
    if request.choice is not None:
        raise UsageError("--policy reference shows a clip: leave out --worst, --best and --failures")


@contextlib.contextmanager
def show_steps(what: str, env: Env, source: "RecordedSource | _NewEpisodes") -> Iterator[Watch]:
    """Show the progress of the episodes of a source; yields what is to be called after every step."""
    most = source.most_steps or describe(env).max_steps
    total = None if most is None else most * len(source.seeds)
    with output.show_progress(what, total, "steps") as show:
        yield count_steps(show, most or 0)


def load_located(path: Path) -> RecordedEpisode:
    """Read an episode, with the absolute path of its task's file; raises `UsageError` for one that a person steered."""
    episode = load_episode(path)
    if episode.info.steered:
        raise UsageError(
            f"{path}: a person steered this episode, so its seed and actions do not reproduce it\n"
            f"see its recording: rerun {path.with_suffix('.rrd')}"
        )
    spec = dataclasses.replace(episode.info.spec, task=locate_task(episode.info.spec.task, find_owner(path)))
    return dataclasses.replace(episode, info=episode.info.model_copy(update={"spec": spec}))


def summarize(rollout: Rollout, recording: Path | None = None, episode: Path | None = None) -> ReplayedEpisode:
    """Return the episode of a rollout for the result."""
    info = rollout.episode.info
    outcome = info.seed, rollout.length, info.total_reward, info.success
    return ReplayedEpisode(*outcome, rollout.env.events, recording, episode)
