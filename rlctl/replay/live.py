"""Living one episode in this process, and everything that can be said of it without looking at the world."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl import registry
from rlctl.env_spec import EnvSpec
from rlctl.errors import ArtifactError, RlctlError, TaskError, describe_exception, format_plugin_traceback
from rlctl.run.env_info import EnvInfo, describe
from rlctl.run.episode import EpisodeInfo, Observations, RecordedEpisode
from rlctl.run.policy import collect_versions

Env = gymnasium.Env[Any, Any]
Choose = Callable[[Any, int], Any]
"""From an observation and the number of steps done to an action; None ends the episode."""
Observer = Callable[[int], None]
"""Called after the reset (with 0) and after every step (with its number)."""


@dataclasses.dataclass(frozen=True)
class Happening:
    """Something worth a line in the log of an episode."""

    step: int
    text: str
    level: str = "INFO"


@dataclasses.dataclass(frozen=True)
class Lived:
    """An episode of T steps that was just lived. Step 0 is the reset; step k is the world after action k."""

    env: EnvInfo
    episode: RecordedEpisode
    weighted_terms: NDArray[np.float64]
    """Shape (T, terms); they add up to the reward."""
    successes: NDArray[np.bool_] | None
    """Whether the goal held after each step, shape (T,); None where the environment does not say."""
    ended: bool
    """Whether the environment ended the episode, and not the list of actions."""
    happenings: list[Happening]
    dt: float | None
    """Time between two steps [s], where known."""

    @property
    def length(self) -> int:
        return len(self.episode.rewards)


def live(
    env: Env, spec: EnvSpec, seed: int, choose: Choose, *, policy: str = "", observers: Sequence[Observer] = ()
) -> Lived:
    """Live the episode of a seed; raises `TaskError`, naming seed and step, for whatever the environment raises."""
    diary = _Diary(env, seed)
    with _blaming(spec.task, seed, diary):
        observation, info = env.reset(seed=seed)
        diary.begin(observation, info)
    for observe in observers:
        observe(0)
    while not diary.over:
        action = choose(observation, diary.step)
        if action is None:
            break
        with _blaming(spec.task, seed, diary):
            observation, reward, terminated, truncated, info = env.step(as_taken(action, env.action_space))
            diary.write(action, observation, float(reward), bool(terminated), bool(truncated), info)
        for observe in observers:
            observe(diary.step)
    return diary.lived(spec, policy)


def frame_time(env: Env) -> float | None:
    """Return the time between two steps [s], where an environment says it."""
    fps = env.metadata.get("render_fps")
    return describe(env).control_dt or (1.0 / fps if fps else None)


def as_taken(action: Any, space: spaces.Space[Any]) -> Any:
    """Return an action as an environment of this space takes it: an int, or an array of the space's dtype."""
    if isinstance(space, spaces.Discrete):
        return int(action)
    return np.array(action, dtype=space.dtype)


def recorded_actions(episode: RecordedEpisode, env: Env, path: Path | None = None) -> Choose:
    """Return the actions of an episode, one after the other; raises `ArtifactError` if they are for another space."""
    check_actions(episode, env.action_space.shape or (), path)
    return lambda _, step: episode.actions[step] if step < len(episode.actions) else None


def check_actions(episode: RecordedEpisode, wanted: tuple[int, ...], path: Path | None = None) -> None:
    """Raise `ArtifactError` if an action of an episode has not the shape that its task wants now."""
    given = episode.actions.shape[1:]
    if given != wanted:
        name = path or f"episode of {episode.info.task}"
        raise ArtifactError(f"{name}: its actions have shape {given}, those of {episode.info.task} have {wanted}")


def present_versions(task: str) -> dict[str, str]:
    """Return the versions that an episode of a task depends on."""
    origin = registry.find_origin(task)
    return {**collect_versions(), **({origin["distribution"]: origin["version"]} if origin else {})}


@contextlib.contextmanager
def _blaming(task: str, seed: int, diary: _Diary) -> Iterator[None]:
    """Name the task, the episode and the step in whatever an environment raises, `SystemExit` included."""
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        ours = isinstance(error, RlctlError)
        what = str(error) if ours else describe_exception(error)
        where = f"in the episode with seed {seed}, step {diary.next_step}; to see it alone: rlctl check-env {task}"
        details = None if ours else format_plugin_traceback(error) or None
        raise TaskError(f"task {task!r}: {what}\n{where}", details=details) from error


class _Diary:
    def __init__(self, env: Env, seed: int) -> None:
        self._info = describe(env)
        self._space = env.observation_space
        self._action_space = env.action_space
        self._dt = frame_time(env)
        self._seed = seed
        self._terms = list(self._info.reward_weights)
        self._observations: list[Any] = []
        self._actions: list[Any] = []
        self._rewards: list[float] = []
        self._raw: list[list[float]] = []
        self._weighted: list[list[float]] = []
        self._successes: list[bool | None] = []
        self._happenings = [Happening(0, f"reset with seed {seed}")]
        self.over = False

    @property
    def step(self) -> int:
        return len(self._rewards)

    @property
    def next_step(self) -> int:
        # An environment that fails at its reset fails at step 0.
        return self.step + 1 if self._observations else 0

    def begin(self, observation: Any, info: dict[str, Any]) -> None:
        self._observations.append(_copied(observation, self._space))
        self._note_events(0, info)

    def write(
        self, action: Any, observation: Any, reward: float, terminated: bool, truncated: bool, info: dict[str, Any]
    ) -> None:
        if not math.isfinite(reward):
            raise ValueError(f"reward is {reward}")
        copied = _copied(observation, self._space)
        self._actions.append(np.array(action))
        self._observations.append(copied)
        self._rewards.append(reward)
        if self._terms:
            self._raw.append([float(info["metrics"][name]) for name in self._terms])
            self._weighted.append([float(info["reward_terms"][name]) for name in self._terms])
        self._note_events(self.step, info)
        success = info.get("is_success")
        self._note_success(None if success is None else bool(success))
        self.over = terminated or truncated
        if self.over:
            self._note_end(terminated)

    def _note(self, text: str, level: str = "INFO") -> None:
        self._happenings.append(Happening(self.step, text, level))

    def _note_events(self, step: int, info: dict[str, Any]) -> None:
        for name, drawn in info.get("events", {}).items():
            values = ", ".join(f"{key} {value:.4g}" for key, value in drawn.items())
            self._happenings.append(Happening(step, f"event {name}: {values}", "DEBUG"))

    def _note_success(self, success: bool | None) -> None:
        before = bool(self._successes and self._successes[-1])
        self._successes.append(success)
        if success and not before:
            self._note("goal reached")
        elif before and not success:
            self._note("goal lost", "WARN")

    def _note_end(self, terminated: bool) -> None:
        self._note("terminated" if terminated else "truncated: time limit")
        if self._successes[-1] is not None:
            self._note(*(("success", "INFO") if self._successes[-1] else ("no success", "WARN")))

    def lived(self, spec: EnvSpec, policy: str) -> Lived:
        steps, terms = self.step, len(self._terms)
        if not self.over:
            self._note("the recorded actions end here", "WARN")
        info = EpisodeInfo.of(
            spec,
            seed=self._seed,
            policy=policy,
            success=self._successes[-1] if steps else None,
            total_reward=sum(self._rewards, 0.0),
            term_names=self._terms,
            versions=present_versions(spec.task),
        )
        actions = np.array(self._actions) if steps else np.zeros((0, *(self._action_space.shape or ())))
        rewards, raw = np.array(self._rewards, np.float64), np.array(self._raw, np.float64).reshape(steps, terms)
        known = [success for success in self._successes if success is not None]
        return Lived(
            env=self._info,
            episode=RecordedEpisode(info, actions, _stacked(self._observations), rewards, raw),
            weighted_terms=np.array(self._weighted, np.float64).reshape(steps, terms),
            successes=np.array(known, np.bool_) if steps and len(known) == steps else None,
            ended=self.over,
            happenings=self._happenings,
            dt=self._dt,
        )


def _copied(observation: Any, space: spaces.Space[Any]) -> Any:
    """Copy an observation in the dtype of its space, as recorded episodes have it; some environments reuse theirs."""
    if isinstance(space, spaces.Dict):
        return {key: _copied(observation[key], part) for key, part in space.spaces.items()}
    value = np.array(observation, dtype=space.dtype)
    if value.shape != space.shape:
        raise ValueError(f"observation has shape {value.shape}, the space has {space.shape}")
    return value


def _stacked(observations: list[Any]) -> Observations:
    if isinstance(observations[0], dict):
        return {key: np.stack([each[key] for each in observations]) for key in observations[0]}
    return np.stack(observations)
