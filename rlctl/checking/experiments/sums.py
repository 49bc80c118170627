"""The experiment `sums`: finds numbers that add up the actions, such as the targets of joints, for rules about them."""

import contextlib
import dataclasses
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rlctl.checking.bullet_worlds import read_states, read_world
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, JudgeHook, experiment
from rlctl.checking.instance import Context, Instance
from rlctl.checking.mujoco_worlds import SLIDE
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged
from rlctl.checking.transitions import flatten_floats, name_floats
from rlctl.checking.values import flatten_action, read_attributes
from rlctl.checking.worlds import JOINTS, Array
from rlctl.environments.bullet_calls import BulletCalls, record_calls
from rlctl.environments.simulations import find_mujoco

RANDOM_STEPS, FEWEST_STEPS = 16, 10
SAME = 1e-3  # part of the largest change: what float32 makes of an action
USUAL = 0.75  # part of the random steps in which a number follows the action: it may be clipped in others
MOTOR_CALLS = ("setJointMotorControl2", "setJointMotorControlArray")


@dataclasses.dataclass(frozen=True, eq=False)
class PlayedSums:
    """What an episode showed after each step."""

    values: Array  # Observed numbers, and attributes. Shape (steps, numbers)
    commands: Array  # of motors. Shape (steps, commands)
    actions: Array  # Shape (steps, numbers)


@dataclasses.dataclass(frozen=True)
class ActionSum:
    """A number that adds up a number of the action."""

    column: int  # of the values
    element: int  # of the action
    factor: float


@dataclasses.dataclass(frozen=True)
class EngineState:
    """The state of all bodies of the engines."""

    joints: list[str]  # the names of those of one degree of freedom
    positions: Array  # of these [rad], [m]. Shape (joints,)
    everything: Array


class SumTrials:
    """Plays episodes of given actions."""

    def __init__(self, instance: Instance, calls: BulletCalls) -> None:
        self.instance, self._calls = instance, calls
        self.has_engine = find_mujoco(instance.env) is not None or bool(instance.find_clients())
        self._attributes: dict[str, int] | None = None  # sizes by name, as after the first reset

    def play(self, seed: int, actions: Sequence[Any] | None = None) -> PlayedSums:
        """Play given actions, or some random ones."""
        values, commands, taken = [], [], []
        steps = RANDOM_STEPS if actions is None else len(actions)
        self._calls.targets.clear()
        for moment in EpisodePlayer(self.instance, seed, "random", max_steps=steps, sequence=actions):
            values.append(self._read(moment.observation))
            commands.append(self._read_commands())
            if moment.step:
                taken.append(flatten_action(self.instance.action_leaves, moment.action))
        if len({row.size for row in values}) > 1:
            raise NotJudged("the observation has more than one size (RL101)")
        sizes = [len(row) for row in commands]
        rows = [row if len(row) == max(sizes) else np.full(max(sizes), np.nan) for row in commands]
        return PlayedSums(np.array(values), np.array(rows), np.array(taken))

    def play_bodies(self, seed: int, actions: Sequence[Any]) -> list[tuple[Array, EngineState]]:
        """Play given actions; return the observed numbers and what the engines have, after the reset and each step."""
        moments = EpisodePlayer(self.instance, seed, "random", max_steps=len(actions), sequence=actions)
        return [(flatten_floats(self.instance.leaves, one.observation), self._read_engines()) for one in moments]

    def _read_engines(self) -> EngineState:
        names: list[str] = []
        positions: list[float] = []
        everything: list[Array] = []
        if (simulation := find_mujoco(self.instance.env)) is not None:
            model, data = simulation
            single = np.flatnonzero(model.jnt_type >= SLIDE).tolist()
            names += [model.joint(joint).name or f"joint {joint}" for joint in single]
            positions += data.qpos[model.jnt_qposadr[single]].tolist()
            everything += [data.qpos.copy(), data.qvel.copy()]
        for client in self.instance.find_clients():
            world = read_world(client)
            for body, state in zip(world.bodies, read_states(world), strict=True):
                names += [body.name_joint(joint) for joint in body.joints]
                positions += state[JOINTS : JOINTS + len(body.joints)].tolist()
                everything.append(state)
        return EngineState(names, np.array(positions), np.concatenate([np.zeros(0), *everything]))

    def name(self, column: int) -> str:
        """Name one of the values."""
        names = name_floats(self.instance.leaves)
        for name, size in (self._attributes or {}).items():
            names += [name] if size == 1 else [f"{name}[{i}]" for i in range(size)]
        return names[column]

    def _read(self, observation: Any) -> Array:
        attributes = read_attributes(self.instance.env)
        if self._attributes is None:
            self._attributes = {name: one.numbers.size for name, one in attributes.items() if one.numbers.size}
        parts = []
        for name, size in self._attributes.items():
            numbers = attributes[name].numbers if name in attributes else np.zeros(0)
            parts.append(numbers if numbers.size == size else np.full(size, np.nan))
        return np.concatenate([flatten_floats(self.instance.leaves, observation), *parts])

    def _read_commands(self) -> Array:
        simulation = find_mujoco(self.instance.env)
        parts = [np.array([given.value for given in self._calls.targets.values()], np.float64)]
        return np.concatenate([*parts, np.array(simulation[1].ctrl if simulation else [], np.float64)])


@dataclasses.dataclass(frozen=True)
class FoundSums:
    """What adds up the actions, in some random steps."""

    trials: SumTrials
    played: PlayedSums
    sums: Sequence[ActionSum]

    @property
    def observed(self) -> int:
        """How many of the values are observed; the others are attributes."""
        return len(name_floats(self.trials.instance.leaves))


judges_sums = JudgeHook[FoundSums]()
"""Shows an instance of which something adds up the actions."""


@experiment("sums", PROBE, 113, share=0.3, hooks=(judges_sums,), seeds_globals=True, alters=True)
def find_action_sums(context: Context) -> Iterator[ChildMessage]:
    """Play some random steps, and find what adds up a number of the action."""
    instance = context.instance
    if not instance.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    if any("float" not in leaf.dtype for leaf in instance.action_leaves) or not instance.action_leaves:
        raise NotApplicable("actions are no real numbers")
    with record_calls(with_results=MOTOR_CALLS) if "pybullet" in sys.modules else _no_calls() as calls:
        trials = SumTrials(instance, calls)
        played = trials.play(FIRST_SEED)
        sums = _find_sums(played)
        if not sums:
            raise NotApplicable("nothing adds up the actions")
        yield from judges_sums.judge(FoundSums(trials, played, sums))


def _no_calls() -> contextlib.AbstractContextManager[BulletCalls]:
    return contextlib.nullcontext(BulletCalls())


def _find_sums(played: PlayedSums) -> list[ActionSum]:
    """Return the numbers that change in each step by a number of the action times a factor."""
    found: list[ActionSum] = []
    if len(played.actions) < FEWEST_STEPS:
        return found
    changes = np.diff(played.values, axis=0)
    for column in np.flatnonzero(np.isfinite(changes).all(axis=0) & (np.abs(changes).max(axis=0) > 0)).tolist():
        change = changes[:, column]
        for element, numbers in enumerate(played.actions.T):
            large = np.abs(numbers) > 0.1 * np.abs(numbers).max(initial=0.0)
            if not large.any():
                continue
            factor = float(np.median(change[large] / numbers[large]))
            near = np.abs(change - factor * numbers) <= SAME * np.abs(change).max()
            if factor and near.mean() >= USUAL:
                found.append(ActionSum(column, element, factor))
    return found
