"""What a sound robot would log: rollouts of the policy in simulation, also of changed robots and with mistakes."""

import contextlib
import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from rlctl.environments.gym_worlds import GymWorlds
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.play.playing import Playing
from rlctl.policy.actor import Actor, Rows
from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings, delay
from rlctl.task.events.event import Widening
from rlctl_robot.diagnose.actor import LoggedActor
from rlctl_robot.diagnose.candidates import TermStatistics, list_candidates
from rlctl_robot.diagnose.correction import EVERYTHING, Correction, list_parts
from rlctl_robot.diagnose.signals import ACTIONS, Array, LoggedSignals

_SOUND_SHARE, _HELD_OUT_SHARE = 0.4, 0.2  # of all steps; the others are with mistakes
_SHORT, _LONG = 30, 160  # steps of an episode: short, so that there are many different ones
_SHORTEST = 20  # steps of an episode that is used
_NOISE = (0.0, 0.05, 0.2, 0.4)  # of half the range of an action
_LITTLE_NOISE = (0.0, 0.05)


@dataclasses.dataclass(frozen=True, eq=False)
class Recordings:
    """Recordings in simulation: what the sensors of the task measured, and what the robot executed."""

    sound: LoggedSignals  # of the policy, of the nominal and of changed robots
    held_out: LoggedSignals  # as `sound`, of other episodes
    varied: LoggedSignals  # of the policy with mistakes and noise: where a robot with a wrong mapping gets
    statistics: Mapping[str, TermStatistics]
    allowed_delay: int  # [control steps]: how late actions can be by the task's own events


def record_reference(spec: EnvSpec, actor: LoggedActor, steps: int, seed: int = 0) -> Recordings:
    """Play the policy in its task for so many control steps in total.

    Raises `UsageError` for a task whose observations or actions are not flat vectors of numbers.
    """
    with contextlib.closing(spec.make()) as env:
        for space, what in ((env.observation_space, "observations"), (env.action_space, "actions")):
            if not isinstance(space, spaces.Box) or len(space.shape) != 1:
                raise UsageError(f"{spec.task}: its {what} are not a vector of numbers; diagnose needs vectors")
        player = _ReferencePlayer(env, actor, np.random.default_rng(seed))
        sound = player.play(int(_SOUND_SHARE * steps))
        held_out = player.play(int(_HELD_OUT_SHARE * steps))
        statistics = measure_statistics(sound)
        candidates = list_candidates(actor.info.env, statistics)
        possible = [one for one in candidates if one.kind in ("order", "sign", "scale", "offset")]
        varied = player.play(
            int((1 - _SOUND_SHARE - _HELD_OUT_SHARE) * steps), lambda: player.draw_mistakes(possible), _NOISE
        )
        return Recordings(sound, held_out, varied, statistics, player.allowed_delay)


def record_mistakes(
    spec: EnvSpec, actor: LoggedActor, mistakes: Sequence[Sequence[Correction]], steps: int, seed: int = 0
) -> LoggedSignals:
    """Play the policy in its task with each of the combinations of mistakes, for so many control steps in total."""
    with contextlib.closing(spec.make()) as env:
        player = _ReferencePlayer(env, actor, np.random.default_rng(seed))
        following = itertools.cycle(mistakes)
        return player.play(steps, lambda: list(next(following)), _LITTLE_NOISE)


def measure_statistics(signals: LoggedSignals) -> dict[str, TermStatistics]:
    """Return mean and standard deviation of each observation and of the actions."""
    found = {}
    for name in [*signals.sizes, ACTIONS]:
        values = signals.term(name)
        std = values.std(axis=0)
        usual = float(std.max()) if std.max() > 0 else 1.0
        norms = np.linalg.norm(values, axis=1)
        is_quaternion = values.shape[1] == 4 and bool(np.allclose(norms, 1.0, atol=1e-3))
        found[name] = TermStatistics(values.mean(axis=0), np.maximum(std, 0.02 * usual), is_quaternion)
    return found


class _ReferencePlayer:
    def __init__(self, env: Any, actor: LoggedActor, rng: np.random.Generator) -> None:
        self._env, self._actor, self._rng = env, actor, rng
        sizes = actor.info.env.observation_sizes
        self._sizes = dict(sizes) or {EVERYTHING: math.prod(env.observation_space.shape)}
        self._range = (actor.high - actor.low) / 2
        self._task_env = env.unwrapped if isinstance(env.unwrapped, TaskEnv) else None
        self.allowed_delay = 0
        self._events: dict[str, dict[str, Any]] = {}
        if self._task_env is not None:
            for name, event in self._task_env.task.events.items():
                if event.function is not delay:
                    self._events[name] = {}
                    continue
                steps = event.bind(name).values["steps"]
                self.allowed_delay += int(steps.end[1] if isinstance(steps, Widening) else steps)

    def play(
        self, steps: int, draw: Callable[[], list[Correction]] = list, noises: Sequence[float] = (0.0,)
    ) -> LoggedSignals:
        """Record episodes, each with the mistakes that `draw` returns: half of them of the nominal robot."""
        parts: list[tuple[Array, Array]] = []
        count, episode = 0, 0
        while count < steps:
            if self._task_env is not None and episode % 2 == 0:
                changes = {} if episode % 4 == 0 else self._events
                self._task_env.set_events(EventSettings(False, changes))
            part = self._play_episode(draw(), float(self._rng.choice(noises)))
            count += len(part[0])
            episode += 1
            if len(part[0]) >= _SHORTEST:
                parts.append(part)
            if episode > 50 and not parts:
                raise UsageError("no episode of this task lasts long enough to be compared with a log")
        observations, actions = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return LoggedSignals(observations, actions, tuple(len(part[0]) for part in parts), self._sizes)

    def draw_mistakes(self, possible: Sequence[Correction]) -> list[Correction]:
        """Return none, one or two mistakes."""
        count = int(self._rng.integers(0, 3))
        return [possible[int(index)] for index in self._rng.integers(0, len(possible), count)]

    def _play_episode(self, mistakes: Sequence[Correction], noise: float) -> tuple[Array, Array]:
        first = np.zeros(1, np.int64)
        mistaken = _MistakenActor(self._actor, mistakes, noise * self._range, self._sizes, self._rng)
        self._actor.begin(Rows.one())
        playing = Playing(GymWorlds(self._env))
        observations = playing.begin(first, [int(self._rng.integers(2**31))])
        length = int(self._rng.integers(_SHORT, _LONG))
        for number, _ in enumerate(playing.play(mistaken, first, observations), start=1):
            if number == length:
                break
        return np.array(mistaken.observations), np.array(mistaken.actions)


class _MistakenActor(Actor):
    """The policy as a faulty program uses it, with disturbances; `noise` is their size per element of the action."""

    def __init__(
        self,
        actor: LoggedActor,
        mistakes: Sequence[Correction],
        noise: Array,
        sizes: Mapping[str, int],
        rng: np.random.Generator,
    ) -> None:
        self._actor, self._mistakes, self._noise, self._rng = actor, list_parts(mistakes), noise, rng
        self._slices = LoggedSignals(np.zeros((0, 0)), np.zeros((0, 0)), (), dict(sizes)).slices
        self._late = sum(one.delay for one in self._mistakes if one.term == ACTIONS)
        self._disturbance = np.zeros(len(actor.low))
        self._sent: list[Array] = []
        self.observations: list[Array] = []  # what the sensors measured
        self.actions: list[Array] = []  # what the robot executed

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the executed action of the only row."""
        step, actor = int(rows.step[0]), self._actor
        self.observations.append(np.array(observations[0], np.float64))
        seen = self.observations[-1].copy()
        for one in self._mistakes:
            if one.term not in self._slices:
                continue
            part = self._slices[one.term]
            measured = seen[part]
            if one.delay:
                measured = self.observations[max(0, step - one.delay)][part]
            seen[part] = one.undo(measured)
        action = actor.act(seen[None], rows)[1][0]
        for one in self._mistakes:
            if one.term == ACTIONS:
                action = one.change(action)
        if self._noise.any():
            drawn = self._rng.standard_normal(len(action))
            self._disturbance = 0.8 * self._disturbance + 0.6 * self._noise * drawn
            action = action + self._disturbance
        self._sent.append(np.clip(action, actor.low, actor.high))
        executed = self._sent[max(0, step - self._late)]
        self.actions.append(executed)
        rows_executed = executed.astype(np.float32)[None]
        return rows_executed, rows_executed
