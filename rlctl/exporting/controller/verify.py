"""Verifies a controller: on recorded quantities, and in closed loop against the task."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rlctl import output
from rlctl.environments.dict_spaces import take_row
from rlctl.environments.gym_worlds import GymWorlds
from rlctl.environments.registry import call_plugin
from rlctl.errors import TaskError
from rlctl.evaluation.episode_statistics import mean_return
from rlctl.exporting.controller.controllers import CController, Controller, Inputs
from rlctl.exporting.controller.plan import ControllerPlan, JointTarget
from rlctl.exporting.verify import (
    EPISODES,
    MAX_DIFFERENCE,
    Agreement,
    ClosedLoop,
    changes_again,
    compare_episodes,
    list_different,
)
from rlctl.limits.limited import Limited
from rlctl.limits.limits import Limits
from rlctl.play.collect import MOST_STEPS, Episode
from rlctl.play.messages import EpisodeResult
from rlctl.play.playing import Playing
from rlctl.play.seeds import Stream, episode_seeds
from rlctl.policy.actor import Actor, Rows, as_rows

_MIN_OBSERVATIONS = 2000
_TIMED_STEPS, _MEAN_OF = 3000, 10


@dataclasses.dataclass(frozen=True)
class Recorded:
    """An episode: what was measured and done in each step."""

    inputs: list[Inputs]
    actions: list[NDArray[Any]]
    episode: Episode
    requested: list[NDArray[Any]] = dataclasses.field(default_factory=list)  # the policy's actions, before the limits
    targets: list[NDArray[Any] | None] = dataclasses.field(default_factory=list)  # those that the limits bound


class TaskPlayer:
    """Plays episodes of the task in this process."""

    def __init__(self, plan: ControllerPlan, env: gymnasium.Env[Any, Any], task: str) -> None:
        self._plan, self._env, self._task = plan, env, task
        self._inputs: Inputs = {}

    def limit(self, actor: Actor, limits: Limits) -> Limited:
        """Return an actor within limits, whose filter observes what the robot measures."""
        return Limited(actor, self._plan.inputs_info, limits, measure=self._measure)

    def _measure(self, row: int) -> NDArray[Any]:
        return np.concatenate([np.ravel(value) for value in self._inputs.values()]).astype(self._plan.dtype)

    def play(self, seed: int, actor: Actor, watch: Callable[[], None] = lambda: None) -> Recorded:
        """Play an episode; raises `TaskError` if the environment fails or the episode does not end.

        A `Controller` observes what the robot measures. `watch` is called when the actor has acted.
        """
        worlds, first = GymWorlds(self._env), np.zeros(1, np.int64)
        playing, recorder = Playing(worlds), _MeasuringActor(self, actor, watch)
        observations = call_plugin(self._task, lambda: playing.begin(first, [seed]))
        actor.begin(Rows.one(seed))
        steps = playing.play(recorder, first, observations)
        while call_plugin(self._task, lambda: next(steps, None)) is not None:
            if worlds.step_of[0] == MOST_STEPS:
                raise TaskError(f"{self._task}: the episode of seed {seed} has not ended after {MOST_STEPS:,} steps")
        totals = worlds.totals()
        result = EpisodeResult(0, seed, totals.reward, int(worlds.step_of[0]), totals.success, {}, None)
        return Recorded(recorder.measured, recorder.actions, Episode(result))

    def measure(self, observation: Any) -> Inputs:
        """Return what the robot measures now."""
        self._inputs = self._plan.measure(observation, getattr(self._env.unwrapped, "measured", {}))
        return self._inputs


class _MeasuringActor(Actor):
    """Acts as another, and keeps what the robot measures and what it does."""

    def __init__(self, player: TaskPlayer, actor: Actor, watch: Callable[[], None]) -> None:
        self._player, self._actor, self._watch = player, actor, watch
        self.measured: list[Inputs] = []
        self.actions: list[NDArray[Any]] = []

    def act(self, observations: Any, rows: Rows) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the actor's action."""
        inputs = self._player.measure(take_row(observations, 0))
        seen = as_rows(inputs) if isinstance(self._actor, Controller) else observations
        stored, actions = self._actor.act(seen, rows)
        self._watch()
        self.measured.append(inputs)
        self.actions.append(actions[0])
        return stored, actions


@dataclasses.dataclass(frozen=True)
class ControllerAgreement:
    """How a controller compares with the policy."""

    agreement: Agreement
    closed_loop: ClosedLoop
    max_target_difference: float | None  # in the unit of the targets; None without targets
    different: tuple[int, ...]  # episodes that differ in closed loop, those that differ most first


def record(player: TaskPlayer, reference: Actor) -> list[Recorded]:
    """Play `EPISODES` episodes, and more until `_MIN_OBSERVATIONS` are recorded."""
    with output.show_progress("closed loop, policy", EPISODES, "episodes") as show:
        return _record(player, reference, show)


def _record(player: TaskPlayer, reference: Actor, show: Callable[[int], None]) -> list[Recorded]:
    recorded: list[Recorded] = []
    while len(recorded) < EPISODES or sum(len(episode.actions) for episode in recorded) < _MIN_OBSERVATIONS:
        show(min(len(recorded), EPISODES))
        seed = episode_seeds(0, Stream.VERIFY, len(recorded) + 1)[-1]
        between: list[tuple[NDArray[Any] | None, NDArray[Any] | None]] = []

        def watch(between: list[Any] = between) -> None:
            if isinstance(reference, Limited):
                between.append((reference.requested[0], _find_target(reference)))

        played = player.play(seed, reference, watch)
        if not isinstance(reference, Limited):
            between += [(action, None) for action in played.actions]
        requested = [np.zeros(np.size(played.actions[0])) if action is None else action for action, _ in between]
        recorded.append(dataclasses.replace(played, requested=requested, targets=[target for _, target in between]))
    return recorded


def _find_target(limited: Limited) -> NDArray[Any] | None:
    """Return a copy of the last target, where the limits bound targets."""
    command = limited.filters[0].command
    return None if command is None or command.target is None else command.target.copy()


def verify_controller(
    player: TaskPlayer, recorded: Sequence[Recorded], controller: Controller, target: JointTarget | None
) -> ControllerAgreement:
    """Compare a controller with recorded episodes, step by step; then let it act in the first of them.

    In each step the policy's action is compared, and what the limits make of the recorded one.
    """
    agreement, worst = Agreement(), 0.0
    with output.show_progress("comparing, step by step", len(recorded), "episodes") as show:
        for number, episode in enumerate(recorded):
            show(number)
            controller.begin()
            steps = zip(episode.inputs, episode.requested, episode.actions, episode.targets, strict=True)
            for step, (inputs, requested, expected, bounded) in enumerate(steps):
                own, action, targets = controller.follow(inputs, requested)
                _compare(agreement, requested, own)
                _compare(agreement, expected, action)
                if target is not None and targets is not None:
                    wanted = target.find_targets(inputs, expected, step) if bounded is None else bounded
                    worst = max(worst, _compare(agreement, wanted, targets))
    agreement.observations = sum(len(episode.actions) for episode in recorded)

    episodes = [episode.episode for episode in recorded[:EPISODES]]
    played: list[Episode] = []
    with output.show_progress("closed loop, controller", len(episodes), "episodes") as show:
        for original in episodes:
            played.append(player.play(original.result.seed, controller).episode)
            show(len(played))
    loop, different = compare_episodes(episodes, played), list_different(episodes, played)
    return ControllerAgreement(agreement, loop, None if target is None else worst, tuple(different))


@dataclasses.dataclass(frozen=True)
class LimitsCost:
    """The same episodes of a policy without limits and within them."""

    episodes: int
    successes: tuple[int, int] | None  # without limits and within them; None if the task reports no success
    mean_returns: tuple[float, float]

    def __str__(self) -> str:
        """Return the scores as one line."""
        free, limited = self.mean_returns
        returns = f"mean return {free:.5g} without the limits, {limited:.5g} within"
        if self.successes is None:
            return f"{self.episodes} episodes: {returns}"
        succeeded, kept = self.successes
        return f"{self.episodes} episodes: success in {succeeded} without the limits, {kept} within; {returns}"


def measure_limits_cost(unlimited: Sequence[Recorded], limited: Sequence[Recorded]) -> LimitsCost:
    """Compare the first `EPISODES` recorded episodes, of the same seeds, without limits and within them."""
    both = [[episode.episode.result for episode in recorded[:EPISODES]] for recorded in (unlimited, limited)]
    free, kept = both
    successes = None
    if any(result.success is not None for result in free):
        successes = sum(bool(result.success) for result in free), sum(bool(result.success) for result in kept)
    mean_returns = mean_return(free), mean_return(kept)
    return LimitsCost(len(free), successes, mean_returns)


def check_conclusive(
    player: TaskPlayer,
    reference: Actor,
    changed: Iterable[Actor],
    recorded: Sequence[Recorded],
    different: Sequence[int],
) -> tuple[bool, bool]:
    """Return whether a policy repeats its recorded episodes, and whether they change with the last bits of its weights.

    `changed` are the policy with other last bits, within the same limits; `different` are the episodes that a
    controller plays otherwise, those that differ most first.
    """
    episodes = [episode.episode for episode in recorded[:EPISODES]]

    def changes(actor: Actor, *, exactly: bool) -> bool:
        def play(seeds: list[int]) -> list[Episode]:
            return [player.play(seed, actor).episode for seed in seeds]

        return changes_again(episodes, different, play, 1, exactly=exactly)

    if changes(reference, exactly=True):
        return False, False
    return True, any(changes(other, exactly=False) for other in changed)


def _compare(agreement: Agreement, expected: NDArray[Any], actual: NDArray[Any]) -> float:
    difference = np.abs(np.asarray(expected, np.float64) - actual)
    # With this comparison NaN is beyond the limit.
    agreement.beyond_limit += int(not (difference <= MAX_DIFFERENCE * np.maximum(1.0, np.abs(expected))).all())
    largest = float(difference.max())
    agreement.max_difference = max(agreement.max_difference, largest)
    return largest


def measure_step(controller: CController, recorded: Sequence[Recorded]) -> tuple[float, float]:
    """Return the median time of a step of recorded episodes, and the time that 99 % of the steps keep [us]."""
    inputs = [inputs for episode in recorded for inputs in episode.inputs]
    rows = np.array([np.concatenate([np.ravel(value) for value in each.values()]) for each in inputs], controller.dtype)
    measured = []
    for count in (_MEAN_OF, 1):
        controller.begin()
        durations = []
        for first in range(0, min(_TIMED_STEPS, len(rows)) - count + 1, count):
            part = rows[first : first + count]
            start = time.perf_counter_ns()
            controller.play(part)
            durations.append((time.perf_counter_ns() - start) / count / 1000.0)
        measured.append(durations)
    return float(np.median(measured[0])), float(np.quantile(measured[1], 0.99))
