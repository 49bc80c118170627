"""Plays an episode in this process and records its numbers, a log, and the scene to draw."""

import contextlib
import dataclasses
import functools
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments import dict_spaces, registry
from rlctl.environments.dict_spaces import map_parts, take_row
from rlctl.environments.gym_worlds import GymWorlds
from rlctl.environments.info import EnvInfo, describe
from rlctl.environments.simulations import find_mujoco
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, RlctlError, TaskError, describe_exception, format_plugin_traceback
from rlctl.play.episode import EpisodeInfo, RecordedEpisode
from rlctl.play.messages import format_hint
from rlctl.play.playing import NoMoreActions, Played, Playing
from rlctl.policy.actor import Actor, Rows
from rlctl.replaying.bullet_scene import TaskReader, WorldsReader
from rlctl.replaying.drawable import DrawableEnv
from rlctl.replaying.mujoco_scene import MujocoReader
from rlctl.replaying.scene import Env, RenderedScene, Scene, Warn
from rlctl.task.env import TaskEnv
from rlctl.task.worlds import WorldsStep
from rlctl.version import collect_versions

Choose = Callable[[Any, int], Any]
"""Returns the action for an observation and the number of steps so far; None ends the episode."""
Watch = Callable[[int], None]  # called with the number of a step after it; 0 is the reset
DEFAULT_DT = 1 / 30  # [s] per step, if an environment gives no time


@dataclasses.dataclass(frozen=True)
class LogEntry:
    """A line in the log of an episode."""

    step: int
    text: str
    level: str = "INFO"


@dataclasses.dataclass(frozen=True)
class Rollout:
    """An episode of T steps that was just played. WorldsStep 0 is the reset; step k is the world after action k."""

    env: EnvInfo
    episode: RecordedEpisode
    weighted_terms: NDArray[np.float64]  # shape (T, terms); they add up to the reward
    successes: NDArray[np.bool_] | None
    """Whether the goal was reached after each step, shape (T,); None if the environment does not report it."""
    ended: bool  # whether the environment ended the episode, rather than the list of actions
    log: list[LogEntry]
    dt: float | None  # time between two steps [s]; None if unknown
    scene: Scene  # empty if the episode was played without `draw`

    @property
    def length(self) -> int:
        """Number of steps, T."""
        return len(self.episode.rewards)


class SceneReader(Protocol):
    """Reads the scene of an environment step by step."""

    def read(self, step: int) -> None:
        """Read the world after a step; 0 is the reset, and forgets what was read before."""

    def scene(self) -> Scene:
        """Return what was read."""


class _PlainReader:
    """Reads the bodies of a plain environment in PyBullet; takes pictures of any other."""

    def __init__(self, env: Env, warn: Warn) -> None:
        self._env = env
        self._warn = warn

    def read(self, step: int) -> None:
        if step == 0:  # only now: many environments load their bodies in the first reset
            self._reader = self._choose()
        self._reader.read(step)

    def _choose(self) -> SceneReader:
        env = self._env
        if isinstance(env, DrawableEnv):
            worlds = WorldsReader(env.bullet_log, self._warn)
            if worlds.find_bodies():
                return worlds
            if env.no_pictures:
                self._warn(f"no camera pictures: {env.no_pictures}")
        return RenderedScene(env, self._warn)

    def scene(self) -> Scene:
        return self._reader.scene()


def make_reader(env: Env, warn: Warn) -> SceneReader:
    """Return the reader for an environment; `warn` receives the reasons for missing parts."""
    if find_mujoco(env):
        return MujocoReader(env)
    inner = env.unwrapped
    return TaskReader(inner) if isinstance(inner, TaskEnv) else _PlainReader(env, warn)


class _Step(NamedTuple):
    """What an environment returned for an action, as copies: an environment may reuse its arrays."""

    action: Any
    observation: Any
    reward: float
    raw: list[float]  # reward terms, by the names of the weights
    weighted: list[float]
    success: bool | None
    events: dict[str, dict[str, float]]


def play_episode(
    env: Env,
    spec: EnvSpec,
    seed: int,
    choose: Choose,
    *,
    policy: str = "",
    draw: Warn | None = None,
    watch: Watch = lambda step: None,
    salvage: Callable[[Rollout], None] = lambda rollout: None,
) -> Rollout:
    """Play the episode of a seed and record it; `watch` is called after the reset and after each step.

    With `draw` the rollout has a scene, and `draw` receives the reasons for missing parts. Raises `TaskError`, with
    seed and step, for any exception of the environment; `salvage` receives the steps before any exception.
    """
    about = describe(env)
    reader = make_reader(env, draw) if draw is not None else None
    read = (lambda step: None) if reader is None else reader.read
    worlds = _LocatedWorlds(env, spec.task, seed, read)
    playing = Playing(worlds)
    steps: list[_Step] = []
    first_row = np.zeros(1, np.int64)
    observations = playing.begin(first_row, [seed])
    first, drawn = take_row(observations, 0), _find_events(worlds.info, about)

    def collect(end: str) -> Rollout:
        successes = [step.success for step in steps if step.success is not None]
        return Rollout(
            env=about,
            episode=_make_episode(spec, seed, policy, about, first, steps, env.action_space),
            weighted_terms=_stack_terms([step.weighted for step in steps], about),
            successes=np.array(successes, np.bool_) if steps and len(successes) == len(steps) else None,
            ended=bool(end),
            log=[LogEntry(0, f"reset with seed {seed}"), *_log_events(0, drawn), *_log_steps(steps, end)],
            dt=find_dt(env),
            scene=Scene() if reader is None else reader.scene(),
        )

    end = ""
    try:
        watch(0)
        for played in playing.play(_Chooser(choose, env.action_space), first_row, observations):
            steps.append(_read_step(played, worlds.info, about))
            if played.result.terminated[0]:
                end = "terminated"
            elif played.result.truncated[0]:
                end = "truncated: time limit"
            watch(len(steps))
    except Exception as error:
        rollout = collect("")
        failure = LogEntry(len(steps), str(error).partition("\n")[0], "WARN")
        salvage(dataclasses.replace(rollout, log=[*rollout.log, failure]))
        raise
    return collect(end)


class _LocatedWorlds(GymWorlds):
    """An environment whose exceptions name the task, the episode and the step; `read` is called after each step."""

    def __init__(self, env: Env, task: str, seed: int, read: Watch) -> None:
        super().__init__(env)
        self._task, self._seed, self._read = task, seed, read

    def reset(self, *arguments: Any) -> Any:
        """Begin the episode."""
        with _locate_errors(self._task, self._seed, 0):
            observations = super().reset(*arguments)
            self._read(0)
        return observations

    def step(self, action: Any, worlds: Any = None) -> WorldsStep:
        """Take a step."""
        with _locate_errors(self._task, self._seed, int(self.step_of[0]) + 1):
            result = super().step(action, worlds)
            self._read(int(self.step_of[0]))
        return result


class _Chooser(Actor):
    """Acts as `choose` says, until it returns None."""

    def __init__(self, choose: Choose, space: spaces.Space[Any]) -> None:
        self._choose, self._space = choose, space

    def act(self, observations: Any, rows: Rows) -> tuple[Any, Any]:
        """Return the chosen action; raises `NoMoreActions` if there is none."""
        action = self._choose(take_row(observations, 0), int(rows.step[0]))
        if action is None:
            raise NoMoreActions
        chosen = np.array(action, self._space.dtype)[None]
        return chosen, chosen


def _read_step(played: Played, info: Mapping[str, Any], about: EnvInfo) -> _Step:
    names = list(about.reward_weights)
    raw, weighted = ([float(info[key][name]) for name in names] for key in ("metrics", "reward_terms"))
    result = played.result
    return _Step(
        action=np.array(played.action[0]),
        observation=map_parts(np.copy, take_row(result.observation, 0)),
        reward=float(result.reward[0]),
        raw=raw,
        weighted=weighted,
        success=None if result.success is None else bool(result.success[0]),
        events=_find_events(info, about),
    )


def _find_events(info: Mapping[str, Any], about: EnvInfo) -> dict[str, dict[str, float]]:
    return info.get("events", {}) if about.events else {}  # may be anything in a plain environment


def _make_episode(
    spec: EnvSpec, seed: int, policy: str, about: EnvInfo, first: Any, steps: list[_Step], space: spaces.Space[Any]
) -> RecordedEpisode:
    rewards = [step.reward for step in steps]
    info = EpisodeInfo(
        spec=spec,
        seed=seed,
        policy=policy,
        success=steps[-1].success if steps else None,
        total_reward=functools.reduce(operator.add, rewards, 0.0),  # as workers add; `sum` rounds differently
        term_names=list(about.reward_weights),
        versions=current_versions(spec.task),
    )
    actions = np.array([step.action for step in steps]) if steps else np.zeros((0, *(space.shape or ())))
    observations = dict_spaces.stack([first, *(step.observation for step in steps)])
    raw = _stack_terms([step.raw for step in steps], about)
    return RecordedEpisode(actions, observations, np.array(rewards, np.float64), raw, info)


def _stack_terms(rows: list[list[float]], about: EnvInfo) -> NDArray[np.float64]:
    return np.array(rows, np.float64).reshape(len(rows), len(about.reward_weights))


def _log_steps(steps: Sequence[_Step], end: str) -> Iterator[LogEntry]:
    """Yield the events of each step, the steps in which the goal was reached or lost, and how the episode ended."""
    held = False
    for number, step in enumerate(steps, start=1):
        yield from _log_events(number, step.events)
        if bool(step.success) != held:
            held = not held
            yield LogEntry(number, "goal reached") if held else LogEntry(number, "goal lost", "WARN")
    yield LogEntry(len(steps), end) if end else LogEntry(len(steps), "no more actions", "WARN")
    if end and (success := steps[-1].success) is not None:
        yield LogEntry(len(steps), "success") if success else LogEntry(len(steps), "no success", "WARN")


def _log_events(step: int, events: Mapping[str, Mapping[str, float]]) -> Iterator[LogEntry]:
    for name, drawn in events.items():
        values = ", ".join(f"{key} {value:.4g}" for key, value in drawn.items())
        yield LogEntry(step, f"event {name}: {values}", "DEBUG")


def join_watches(*watches: Watch) -> Watch:
    """Return a function that calls several."""

    def watch(step: int) -> None:
        for call in watches:
            call(step)

    return watch


def count_steps(show: Callable[[int], None], most_steps: int) -> Watch:
    """Return a function that shows how many steps are done of episodes that have `most_steps` each.

    An episode that ends early counts as a whole one.
    """
    episode = -1

    def watch(step: int) -> None:
        nonlocal episode
        if step == 0:
            episode += 1
        show(episode * most_steps + step)

    return watch


def find_dt(env: Env) -> float | None:
    """Return the time between two steps [s]; None if the environment does not give it."""
    fps = env.metadata.get("render_fps")
    return describe(env).control_dt or (1.0 / fps if fps else None)


def recorded_actions(episode: RecordedEpisode, space: spaces.Space[Any], path: Path | None = None) -> Choose:
    """Return a function that chooses the recorded actions; raises `ArtifactError` if they cannot be replayed."""
    recorded, shape, task = episode.actions.shape[1:], space.shape or (), episode.info.spec.task
    if recorded != shape:
        name = path or f"episode of {task}"
        raise ArtifactError(f"{name}: its actions have shape {recorded}, but those of {task} have {shape}")
    return lambda _, step: episode.actions[step] if step < len(episode.actions) else None


def current_versions(task: str) -> dict[str, str]:
    """Return the versions that an episode of a task depends on."""
    origin = registry.find_origin(task)
    return {**collect_versions(), **({origin["distribution"]: origin["version"]} if origin else {})}


@contextlib.contextmanager
def _locate_errors(task: str, seed: int, step: int) -> Iterator[None]:
    """Add the task, the episode and the step to any exception of an environment, `SystemExit` included."""
    try:
        yield
    except (Exception, SystemExit) as error:
        ours = isinstance(error, RlctlError)
        what = str(error) if ours else describe_exception(error)
        where = f"in the episode with seed {seed}, step {step}; {format_hint(task)}"
        details = None if ours else format_plugin_traceback(error) or None
        raise TaskError(f"task {task!r}: {what}\n{where}", details=details) from error
