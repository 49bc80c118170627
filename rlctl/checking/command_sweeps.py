"""Moves a number of a command over a wide range at moments of episodes, to see for which value a step pays most."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import attitudes
from rlctl.checking.bullet_worlds import read_world
from rlctl.checking.drawn_goals import DrawnGoal, DrawnPlace
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.goal_episodes import GoalEpisode, GoalTrials
from rlctl.checking.instance import EnvironmentRaised, Instance
from rlctl.checking.mujoco_worlds import FREE
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.snapshots import Beginnings, Snapshot
from rlctl.environments.bullet_clients import ClientCalls
from rlctl.environments.simulations import find_mujoco

Array = NDArray[np.float64]
MOMENTS = [(seed, steps) for steps in (5, 9) for seed in range(FIRST_SEED, FIRST_SEED + 4)]
"""Seeds of episodes, and how many random steps are played before the command is changed."""
FEWEST = 6  # moments that have to be played
NEAR = (0.0, 0.3, 0.7, 1.2, 2.5)  # how far from the middle of the drawn range, in widths of it
FAR = (5.0, 10.0, 20.0)  # the same, where nothing nearer pays most
SECTIONS = 14  # golden ones, of the interval around the best value
GOLDEN = (np.sqrt(5) - 1) / 2
SMALL = 0.05  # part of that interval in which rewards may round to the same
SAME = 1e-12  # relative error of rewards
STRAIGHT = 1e-6  # part of the change of a reward by which a line may be missed
DRAWN = 9  # resets, whose commands give the range


@dataclasses.dataclass(frozen=True)
class BaseMotion:
    """How the free base of a robot moves."""

    turn: Array  # from its frame into the world. Shape (3, 3)
    velocity: Array  # in the world [m/s]
    rates: Array  # angular velocity in the world [rad/s]


@dataclasses.dataclass(frozen=True)
class SweptCommand:
    """What a step pays for many values of a number of a command, at one moment."""

    values: Array  # that were tried, in rising order. Shape (n,)
    rewards: Array  # Shape (n,)
    best: float  # the value that pays most; NaN where it is at an end, or several pay the same
    worst: float  # the value that pays least, if farther ones pay more and more to both sides; else NaN
    observed: Array  # The numbers that are floats, with the command as it was drawn. Shape (elements,)
    base: BaseMotion | None  # None where there is no single robot with a free base in an engine

    @property
    def grows_upwards(self) -> bool:
        """Whether a larger value always pays at least as much, and the largest one more than the one before."""
        return bool((np.diff(self.rewards) >= 0).all() and self._rises(-2, -1))

    @property
    def grows_downwards(self) -> bool:
        """Whether a smaller value always pays at least as much, and the smallest one more than the one after."""
        return bool((np.diff(self.rewards) <= 0).all() and self._rises(1, 0))

    @property
    def slope(self) -> float:
        """How the reward changes with the command, if it is a line; else NaN."""
        slope, offset = np.polyfit(self.values, self.rewards, 1)
        error = np.abs(slope * self.values + offset - self.rewards).max()
        return float(slope) if error <= STRAIGHT * np.ptp(self.rewards) else np.nan

    def _rises(self, one: int, other: int) -> bool:
        return bool(self.rewards[other] - self.rewards[one] > SAME * max(1.0, abs(self.rewards[one])))


@dataclasses.dataclass(frozen=True)
class CommandSweep:
    """A number of a command, swept at several moments."""

    drawn: Array  # the values of some resets. Shape (DRAWN,)
    moments: Sequence[SweptCommand]

    @property
    def best(self) -> Array:
        """The values that pay most. Shape (moments,)."""
        return np.array([moment.best for moment in self.moments])


def sweep_command(instance: Instance, place: DrawnPlace) -> CommandSweep | None:
    """Sweep a number of a command; None where too few moments can be played, time runs out, or the environment does not
    take such commands."""
    trials = GoalTrials(instance, DrawnGoal(place, (), (), {}, {}), begun=_SweptBeginnings())
    try:
        drawn = _draw(instance, place)
        moments = []
        for seed, steps in MOMENTS:
            if instance.context.budget.is_over():
                return None
            if (swept := _sweep(_Moment(trials, seed, steps), drawn)) is not None:
                moments.append(swept)
    except EnvironmentRaised:  # a table may end, or a number overflow
        return None
    return CommandSweep(drawn, moments) if len(moments) >= FEWEST else None


class _SweptBeginnings(Beginnings):
    """Keeps the state also where resets are fast: each moment is played for dozens of values, and the steps before it
    take longer than a reset. PyBullet puts a state back with rounding errors, which may decide which value is best."""

    def keep(self, episode: EpisodePlayer, key: Any, values: Mapping[str, Any]) -> None:
        instance = episode.instance
        if self._is_useful is None and not instance.find_clients():
            with contextlib.suppress(LookupError):
                self._is_useful = Snapshot(instance).is_faithful(episode)
        super().keep(episode, key, values)


def _draw(instance: Instance, place: DrawnPlace) -> Array:
    drawn = []
    for seed in range(FIRST_SEED, FIRST_SEED + DRAWN):
        instance.reset(seed)
        drawn.append(float(place.read(instance.env)[0]))
    return np.array(drawn)


@dataclasses.dataclass(frozen=True)
class _Moment:
    """A step that can be played again and again, each time with another command."""

    trials: GoalTrials
    seed: int
    steps: int

    def begin(self) -> GoalEpisode | None:
        """Play the steps before; None if the episode ends."""
        episode = GoalEpisode(self.trials, self.seed, "random", self.steps)
        return None if episode.has_ended else episode

    def pay(self, value: float) -> float:
        """Return what the step pays; NaN if it is not played."""
        episode = self.begin()
        return np.nan if episode is None else episode.step(np.array([value])).reward


def _sweep(moment: _Moment, drawn: Array) -> SweptCommand | None:
    episode = moment.begin()
    if episode is None:
        return None
    episode.step()
    observed, base = episode.observed, read_base_motion(moment.trials.instance)
    middle, width = (drawn.min() + drawn.max()) / 2, float(np.ptp(drawn))
    paid: dict[float, float] = {}
    for parts in (NEAR, FAR):
        for part in (sign * part for part in parts for sign in (-1, 1)):
            value = float(middle + width * part)
            if value not in paid:
                paid[value] = moment.pay(value)
        values = np.array(sorted(paid))
        rewards = np.array([paid[value] for value in values.tolist()])
        if not np.isfinite(rewards).all():
            return None
        if 0 < rewards.argmax() < len(rewards) - 1:
            break
    best = _find_best(moment.pay, values, rewards)
    worst = _find_best(lambda value: -moment.pay(value), values, -rewards) if _is_valley(rewards) else np.nan
    return SweptCommand(values, rewards, best, worst, observed, base)


def _is_valley(rewards: Array) -> bool:
    lowest = int(rewards.argmin())
    falls, rises = np.diff(rewards[: lowest + 1]) < 0, np.diff(rewards[lowest:]) > 0
    return bool(falls.size and rises.size and falls.all() and rises.all())


def _find_best(pay: Callable[[float], float], values: Array, rewards: Array) -> float:
    """Return the value that pays most, by golden sections; NaN where it is at an end, or others pay the same."""
    place = int(rewards.argmax())
    if place in (0, len(values) - 1) or (rewards == rewards[place]).sum() > 1:
        return np.nan
    low, high = float(values[place - 1]), float(values[place + 1])
    one, two = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    paid_one, paid_two = pay(one), pay(two)
    for _ in range(SECTIONS):
        if paid_one == paid_two:
            is_small = high - low < SMALL * (values[place + 1] - values[place - 1])
            return (low + high) / 2 if is_small else np.nan  # float32 rounds, or several pay the same
        if paid_one > paid_two:
            high, two, paid_two = two, one, paid_one
            one = high - GOLDEN * (high - low)
            paid_one = pay(one)
        else:
            low, one, paid_one = one, two, paid_two
            two = low + GOLDEN * (high - low)
            paid_two = pay(two)
    return (low + high) / 2


def read_base_motion(instance: Instance) -> BaseMotion | None:
    """Return how the base of the robot moves, if the engine has one robot, and its base is free."""
    found = list(_list_motions(instance))
    return found[0] if len(found) == 1 else None


def _list_motions(instance: Instance) -> Iterator[BaseMotion]:
    if (simulation := find_mujoco(instance.env)) is not None:
        model, data = simulation
        for joint in np.flatnonzero(model.jnt_type == FREE).tolist():
            tree = model.body_rootid == model.body_rootid[model.jnt_bodyid[joint]]
            if tree.sum() > 1 or (model.jnt_type == FREE).sum() == 1:
                q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
                w, *xyz = data.qpos[q + 3 : q + 7]
                (turn,) = attitudes.compute_matrices(np.array([[*xyz, w]]))
                yield BaseMotion(turn, data.qvel[v : v + 3].copy(), turn @ data.qvel[v + 3 : v + 6])
        return
    for client in instance.find_clients():
        p = ClientCalls(client)
        bodies = [body for body in read_world(client).bodies if body.is_free]
        robots = [body for body in bodies if body.joints] or bodies
        for body in robots:
            velocity, rates = (np.array(part) for part in p.getBaseVelocity(body.id))
            turn = np.array(p.getMatrixFromQuaternion(p.getBasePositionAndOrientation(body.id)[1])).reshape(3, 3)
            yield BaseMotion(turn, velocity, rates)
