"""Plays an episode in this process and records it: its numbers, a log, and what can be drawn of it."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl import dict_spaces, registry
from rlctl.env_spec import EnvSpec
from rlctl.errors import ArtifactError, RlctlError, TaskError, describe_exception, format_plugin_traceback
from rlctl.replay.scene import Env, Scene, Warn, make_reader
from rlctl.run.env_info import EnvInfo, describe
from rlctl.run.episode import EpisodeInfo, RecordedEpisode
from rlctl.run.policy import collect_versions

Choose = Callable[[Any, int], Any]
"""From an observation and the number of steps done to an action; None ends the episode."""
Watch = Callable[[int], None]
"""Looks at an environment after a step; 0 is the reset."""


@dataclasses.dataclass(frozen=True)
class LogEntry:
    """A line in the log of an episode."""

    step: int
    text: str
    level: str = "INFO"


@dataclasses.dataclass(frozen=True)
class Rollout:
    """An episode of T steps that was just played. Step 0 is the reset; step k is the world after action k."""

    env: EnvInfo
    episode: RecordedEpisode
    weighted_terms: NDArray[np.float64]
    """Shape (T, terms); they add up to the reward."""
    successes: NDArray[np.bool_] | None
    """Whether the goal held after each step, shape (T,); None where the environment does not report it."""
    ended: bool
    """Whether the environment ended the episode, rather than the list of actions."""
    log: list[LogEntry]
    dt: float | None
    """Time between two steps [s], where known."""
    scene: Scene
    """Empty if nothing was to be drawn."""

    @property
    def length(self) -> int:
        """Number of steps, T."""
        return len(self.episode.rewards)


def make_drawable(spec: EnvSpec, warn: Warn) -> Env:
    """Build an environment that can be drawn; `warn` receives why there will be no pictures."""
    if registry.is_task(spec.constructor()):
        return spec.make()  # its bodies are drawn; pictures would be slow and show less
    try:
        return spec.make("rgb_array")
    except RlctlError as error:
        env = spec.make()  # raises again if drawing was not the reason
        warn(f"no camera pictures: {str(error).splitlines()[0]}")
        return env


def play_episode(
    env: Env,
    spec: EnvSpec,
    seed: int,
    choose: Choose,
    *,
    policy: str = "",
    draw: Warn | None = None,
    watch: Watch = lambda step: None,
) -> Rollout:
    """Play the episode of a seed and record it; `watch` is called after its reset and each of its steps.

    With `draw` the rollout has a scene, and `draw` receives why parts of it are missing. Raises `TaskError`, with
    seed and step, for whatever the environment raises.
    """
    recorder = EpisodeRecorder(env, seed)
    reader = make_reader(env, draw) if draw is not None else None
    looks = [watch] if reader is None else [reader.read, watch]
    with _locate_errors(spec.task, recorder):
        observation, info = env.reset(seed=seed)
        recorder.begin(observation, info)
    for look in looks:
        look(0)
    while not recorder.over and (action := choose(observation, recorder.step)) is not None:
        with _locate_errors(spec.task, recorder):
            observation, reward, terminated, truncated, info = env.step(_cast_action(action, env.action_space))
            recorder.add_step(action, observation, float(reward), bool(terminated), bool(truncated), info)
        for look in looks:
            look(recorder.step)
    return recorder.rollout(spec, policy, Scene() if reader is None else reader.scene())


def frame_time(env: Env) -> float | None:
    """Return the time between two steps [s], where an environment has it."""
    fps = env.metadata.get("render_fps")
    return describe(env).control_dt or (1.0 / fps if fps else None)


def recorded_actions(episode: RecordedEpisode, env: Env, path: Path | None = None) -> Choose:
    """Return what chooses the actions of a recorded episode; raises `ArtifactError` if they are for another space."""
    check_actions(episode, env.action_space.shape or (), path)
    return lambda _, step: episode.actions[step] if step < len(episode.actions) else None


def check_actions(episode: RecordedEpisode, shape: tuple[int, ...], path: Path | None = None) -> None:
    """Raise `ArtifactError` if the actions of an episode do not have the shape that its task has now."""
    given = episode.actions.shape[1:]
    if given != shape:
        name = path or f"episode of {episode.info.spec.task}"
        raise ArtifactError(f"{name}: its actions have shape {given}, those of {episode.info.spec.task} have {shape}")


def current_versions(task: str) -> dict[str, str]:
    """Return the versions that an episode of a task depends on."""
    origin = registry.find_origin(task)
    return {**collect_versions(), **({origin["distribution"]: origin["version"]} if origin else {})}


def _cast_action(action: Any, space: spaces.Space[Any]) -> Any:
    return int(action) if isinstance(space, spaces.Discrete) else np.array(action, dtype=space.dtype)


@contextlib.contextmanager
def _locate_errors(task: str, recorder: EpisodeRecorder) -> Iterator[None]:
    """Add the task, the episode and the step to whatever an environment raises, `SystemExit` included."""
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        ours = isinstance(error, RlctlError)
        what = str(error) if ours else describe_exception(error)
        where = f"in the episode with seed {recorder.seed}, step {recorder.next_step}"
        details = None if ours else format_plugin_traceback(error) or None
        message = f"task {task!r}: {what}\n{where}; to see it alone: rlctl check-env {task}"
        raise TaskError(message, details=details) from error


class EpisodeRecorder:
    """Collects what an episode is made of, step by step."""

    def __init__(self, env: Env, seed: int) -> None:
        self.seed = seed
        self.over = False
        self._env = env
        self._info = describe(env)
        self._terms = list(self._info.reward_weights)
        self._observations: list[Any] = []
        self._actions: list[Any] = []
        self._rewards: list[float] = []
        self._raw: list[list[float]] = []
        self._weighted: list[list[float]] = []
        self._successes: list[bool | None] = []
        self._log = [LogEntry(0, f"reset with seed {seed}")]

    @property
    def step(self) -> int:
        """Number of steps done."""
        return len(self._rewards)

    @property
    def next_step(self) -> int:
        """Number of the step that is under way; an environment that fails at its reset fails at step 0."""
        return self.step + 1 if self._observations else 0

    def begin(self, observation: Any, info: dict[str, Any]) -> None:
        """Add what a reset returned."""
        self._observations.append(copy_observation(observation, self._env.observation_space))
        self._log_events(0, info)

    def add_step(
        self, action: Any, observation: Any, reward: float, terminated: bool, truncated: bool, info: dict[str, Any]
    ) -> None:
        """Add an action and what the step returned."""
        if not math.isfinite(reward):
            raise ValueError(f"reward is {reward}")
        copied = copy_observation(observation, self._env.observation_space)
        self._actions.append(np.array(action))
        self._observations.append(copied)
        self._rewards.append(reward)
        if self._terms:
            self._raw.append([float(info["metrics"][name]) for name in self._terms])
            self._weighted.append([float(info["reward_terms"][name]) for name in self._terms])
        self._log_events(self.step, info)
        success = info.get("is_success")
        self._add_success(None if success is None else bool(success))
        self.over = terminated or truncated
        if self.over:
            self._log_end(terminated)

    def rollout(self, spec: EnvSpec, policy: str, scene: Scene) -> Rollout:
        """Return the episode as played so far."""
        steps, terms = self.step, len(self._terms)
        if not self.over:
            self._add_log("the recorded actions end here", "WARN")
        info = EpisodeInfo(
            spec=spec,
            seed=self.seed,
            policy=policy,
            success=self._successes[-1] if steps else None,
            total_reward=sum(self._rewards, 0.0),
            term_names=self._terms,
            versions=current_versions(spec.task),
        )
        actions = np.array(self._actions) if steps else np.zeros((0, *(self._env.action_space.shape or ())))
        rewards, raw = np.array(self._rewards, np.float64), np.array(self._raw, np.float64).reshape(steps, terms)
        known = [success for success in self._successes if success is not None]
        return Rollout(
            env=self._info,
            episode=RecordedEpisode(info, actions, dict_spaces.stack(self._observations), rewards, raw),
            weighted_terms=np.array(self._weighted, np.float64).reshape(steps, terms),
            successes=np.array(known, np.bool_) if steps and len(known) == steps else None,
            ended=self.over,
            log=self._log,
            dt=frame_time(self._env),
            scene=scene,
        )

    def _add_log(self, text: str, level: str = "INFO") -> None:
        self._log.append(LogEntry(self.step, text, level))

    def _log_events(self, step: int, info: dict[str, Any]) -> None:
        for name, drawn in info.get("events", {}).items():
            values = ", ".join(f"{key} {value:.4g}" for key, value in drawn.items())
            self._log.append(LogEntry(step, f"event {name}: {values}", "DEBUG"))

    def _add_success(self, success: bool | None) -> None:
        before = bool(self._successes and self._successes[-1])
        self._successes.append(success)
        if success and not before:
            self._add_log("goal reached")
        elif before and not success:
            self._add_log("goal lost", "WARN")

    def _log_end(self, terminated: bool) -> None:
        self._add_log("terminated" if terminated else "truncated: time limit")
        if self._successes[-1] is not None:
            self._add_log(*(("success", "INFO") if self._successes[-1] else ("no success", "WARN")))


def copy_observation(observation: Any, space: spaces.Space[Any]) -> Any:
    """Copy an observation in the dtype of its space, as recorded episodes have it; some environments reuse theirs."""
    if isinstance(space, spaces.Dict):
        return {key: copy_observation(observation[key], part) for key, part in space.spaces.items()}
    value = np.array(observation, dtype=space.dtype)
    if value.shape != space.shape:
        raise ValueError(f"observation has shape {value.shape}, the space has {space.shape}")
    return value
