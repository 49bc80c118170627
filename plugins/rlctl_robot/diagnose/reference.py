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
from rlctl.task.events import EventSettings, delay
from rlctl.task.events.event import Widening
from rlctl.task.worlds import TaskWorlds
from rlctl_robot.diagnose.actor import LoggedActor
from rlctl_robot.diagnose.candidates import TermStatistics, list_candidates
from rlctl_robot.diagnose.correction import EVERYTHING, Correction, list_parts
from rlctl_robot.diagnose.signals import ACTIONS, Array, LoggedSignals

_SOUND_SHARE, _HELD_OUT_SHARE = 0.4, 0.2  # of all steps; the others are with mistakes
_SHORT, _LONG = 30, 160  # steps of an episode: short, so that there are many different ones
_SHORTEST = 20  # steps of an episode that is used
_MOST_SHORT = 50  # episodes, after which one must have been long enough
_WORLDS = 16  # that play together, of a task in many worlds
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
    with contextlib.closing(_make_worlds(spec, actor)) as worlds:
        for space, what in ((worlds.observation_space, "observations"), (worlds.action_space, "actions")):
            if not isinstance(space, spaces.Box) or len(space.shape) != 1:
                raise UsageError(f"{spec.task}: its {what} are not a vector of numbers; diagnose needs vectors")
        player = _ReferencePlayer(worlds, actor, np.random.default_rng(seed))
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
    with contextlib.closing(_make_worlds(spec, actor)) as worlds:
        player = _ReferencePlayer(worlds, actor, np.random.default_rng(seed))
        following = itertools.cycle(mistakes)
        return player.play(steps, lambda: list(next(following)), _LITTLE_NOISE)


def _make_worlds(spec: EnvSpec, actor: LoggedActor) -> TaskWorlds | GymWorlds:
    """Return worlds in which episodes play together, where the task has many and the policy acts on rows."""
    if spec.is_batch and not spec.has_wrappers and actor.in_rows:
        return spec.make_worlds(_WORLDS)
    return GymWorlds(spec.make())


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
    def __init__(self, worlds: TaskWorlds | GymWorlds, actor: LoggedActor, rng: np.random.Generator) -> None:
        self._worlds, self._actor, self._rng = worlds, actor, rng
        sizes = actor.info.env.observation_sizes
        self._sizes = dict(sizes) or {EVERYTHING: math.prod(worlds.observation_space.shape or ())}
        self._range = (actor.high - actor.low) / 2
        self._task_worlds = worlds if isinstance(worlds, TaskWorlds) else worlds.task_worlds
        self.allowed_delay = 0
        self._events: dict[str, dict[str, Any]] = {}
        if self._task_worlds is not None:
            for name, event in self._task_worlds.task.events.items():
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
        count, played = 0, 0
        together = self._worlds.count
        in_turn = 4 if together == 1 else 2 * together  # episodes, the first half of them of the nominal robot
        while count < steps:
            if self._task_worlds is not None and played % (in_turn // 2) == 0:
                changes = {} if played % in_turn == 0 else self._events
                self._task_worlds.set_events(EventSettings(False, changes))
            episodes = [self._begin_episode(draw(), float(self._rng.choice(noises))) for _ in range(together)]
            self._play_episodes(episodes)
            played += together
            recorded = [(np.array(one.observations), np.array(one.actions)) for one in episodes]
            count += sum(len(observations) for observations, _ in recorded)
            parts += [part for part in recorded if len(part[0]) >= _SHORTEST]
            if played > _MOST_SHORT and not parts:
                raise UsageError("no episode of this task lasts long enough to be compared with a log")
        observations, actions = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return LoggedSignals(observations, actions, tuple(len(part[0]) for part in parts), self._sizes)

    def draw_mistakes(self, possible: Sequence[Correction]) -> list[Correction]:
        """Return none, one or two mistakes."""
        count = int(self._rng.integers(0, 3))
        return [possible[int(index)] for index in self._rng.integers(0, len(possible), count)]

    def _begin_episode(self, mistakes: Sequence[Correction], noise: float) -> "_FaultyProgram":
        return _FaultyProgram(self._actor, mistakes, noise * self._range, self._sizes, self._rng)

    def _play_episodes(self, episodes: Sequence["_FaultyProgram"]) -> None:
        index = np.arange(len(episodes))
        self._actor.begin(Rows.first(len(episodes)))
        playing = Playing(self._worlds)
        observations = playing.begin(index, [int(self._rng.integers(2**31)) for _ in episodes])
        lengths = np.array([int(self._rng.integers(_SHORT, _LONG)) for _ in episodes])
        actor = _MistakenActor(self._actor, episodes)
        for played in playing.play(actor, index, observations):
            finished = played.index[self._worlds.step_of[played.index] >= lengths[played.index]]
            if len(finished):
                playing.stop(finished)


class _FaultyProgram:
    """What a faulty program makes of an episode, with disturbances; `noise` is their size per element of the action."""

    def __init__(
        self,
        actor: LoggedActor,
        mistakes: Sequence[Correction],
        noise: Array,
        sizes: Mapping[str, int],
        rng: np.random.Generator,
    ) -> None:
        self._mistakes, self._noise, self._rng = list_parts(mistakes), noise, rng
        self._low, self._high = actor.low, actor.high
        self._slices = LoggedSignals(np.zeros((0, 0)), np.zeros((0, 0)), (), dict(sizes)).slices
        self._late = sum(one.delay for one in self._mistakes if one.term == ACTIONS)
        self._disturbance = np.zeros(len(actor.low))
        self._sent: list[Array] = []
        self.observations: list[Array] = []  # what the sensors measured
        self.actions: list[Array] = []  # what the robot executed

    def read(self, measured: Array) -> Array:
        """Return what the policy sees of the next measured row."""
        step = len(self.observations)
        self.observations.append(np.array(measured, np.float64))
        seen = self.observations[-1].copy()
        for one in self._mistakes:
            if one.term not in self._slices:
                continue
            part = self._slices[one.term]
            values = seen[part]
            if one.delay:
                values = self.observations[max(0, step - one.delay)][part]
            seen[part] = one.undo(values)
        return seen

    def execute(self, action: Array) -> Array:
        """Return what the robot executes when the policy returns an action."""
        for one in self._mistakes:
            if one.term == ACTIONS:
                action = one.change(action)
        if self._noise.any():
            drawn = self._rng.standard_normal(len(action))
            self._disturbance = 0.8 * self._disturbance + 0.6 * self._noise * drawn
            action = action + self._disturbance
        self._sent.append(np.clip(action, self._low, self._high))
        self.actions.append(self._sent[max(0, len(self._sent) - 1 - self._late)])
        return self.actions[-1]


class _MistakenActor(Actor):
    """The policy as faulty programs use it, one in each row."""

    def __init__(self, actor: LoggedActor, programs: Sequence[_FaultyProgram]) -> None:
        self._actor, self._programs = actor, programs

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the executed actions."""
        programs = [self._programs[row] for row in rows.index.tolist()]
        pairs = zip(programs, observations, strict=True)
        seen = np.stack([program.read(measured) for program, measured in pairs])
        actions = self._actor.act(seen, rows)[1]
        pairs = zip(programs, actions, strict=True)
        executed = np.stack([program.execute(action) for program, action in pairs]).astype(np.float32)
        return executed, executed
