"""The experiment `worlds`: watches the simulated worlds of an instance, for rules about physics and robots."""

import collections
import contextlib
import dataclasses
import functools
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.engine_values import EngineValues, ScaledValue, find_scaled
from rlctl.checking.experiment import INSTANCES, JudgeHook, experiment
from rlctl.checking.instance import Context, EnvironmentRaised, Instance, describe_failure
from rlctl.checking.joint_copies import JointCopy, find_copies
from rlctl.checking.motor_commands import CommandSpan, MotorCommands
from rlctl.checking.mujoco_calls import MujocoCalls, join_calls
from rlctl.checking.mujoco_trials import Look, are_equal, play
from rlctl.checking.mujoco_worlds import MujocoStateReader
from rlctl.checking.readings import join_logs
from rlctl.checking.records import FIRST_SEED, ChildMessage, Shortened, Skipped
from rlctl.checking.rule import NotApplicable, NotJudged, RuleFinding
from rlctl.checking.values import name_numbers
from rlctl.checking.world_logs import LoggedWorld, WorldLog, WorldLogger
from rlctl.checking.worlds import VELOCITY, Array
from rlctl.environments.bullet_calls import BulletCalls, record_calls
from rlctl.environments.bullet_clients import find_clients

ENGINES = {"pybullet", "mujoco"}
EPISODES = (("zero", 50), ("random", 60), ("random", 60), ("extreme", 50), ("random", 60)) + (("random", 2),) * 16
"""Actions and logged steps. The last ones are for what resets draw."""
THROWN_EPISODES, THROWN_STEPS = (1, 2), 40  # in which free bodies are thrown that hardly moved
STILL = 0.02  # standard deviation of a velocity [m/s]
FEWEST_MOVING = 40  # looks in which a body moves: objects are hit now and then
ENOUGH_EPISODES, PART_FOR_THE_REST = 5, 0.3  # of a slow environment; of the experiment's time


@dataclasses.dataclass(frozen=True)
class ObservedWorld:
    """A world, and what the environment observed of it."""

    world: LoggedWorld
    logs: list[WorldLog]
    observed: Array  # In all looks. Shape (looks, elements)

    @functools.cached_property
    def copies(self) -> list[JointCopy]:
        """The elements of the observation that are a copy of one value of one joint."""
        return find_copies(self.logs, self.observed)

    def name_element(self, column: int) -> str:
        """Return how to write an element of the observation: `observation[3]`, or `observation['velocity'][0]`."""
        return self.name_elements(column)

    def name_elements(self, first: int, count: int = 1) -> str:
        """Return how to write elements of the observation that follow each other."""
        return name_numbers(self.logs[0].parts, first, count)

    @property
    def sizes(self) -> list[int]:
        """How many looks each episode has."""
        return [len(log.observed) for log in self.logs]

    @property
    def episodes(self) -> NDArray[np.int_]:
        """The number of the episode of each look."""
        return np.repeat(np.arange(len(self.logs)), self.sizes)

    @functools.cached_property
    def scaled(self) -> list[ScaledValue]:
        """The elements of the observation that are a value of the engine times a factor, perhaps with noise."""
        return find_scaled(EngineValues.read(self.logs), self.observed, self.sizes)


@dataclasses.dataclass(frozen=True)
class WatchedWorlds:
    """The worlds of an instance that were logged and are there still, and what was called in them."""

    instance: Instance
    worlds: Sequence[LoggedWorld]
    calls: BulletCalls
    mujoco_calls: MujocoCalls
    low: Array  # Of the action. Shape (n,)
    high: Array
    logger: WorldLogger

    @functools.cached_property
    def driven(self) -> list[tuple[LoggedWorld, list[CommandSpan]]]:
        """The worlds, and between what its actions drive the motors of each, where that is known."""
        commands = [MotorCommands.read(world, self.low, self.high) for world in self.worlds]
        spans = [[] if one is None else one.find_spans() for one in commands]
        return list(zip(self.worlds, spans, strict=True))

    @functools.cached_property
    def observed(self) -> list[ObservedWorld]:
        """The worlds with enough observations to compare with what the engine has."""
        joined = [(world, join_logs(world)) for world in self.worlds]
        return [ObservedWorld(world, *both) for world, both in joined if both is not None]

    @functools.cached_property
    def thrown(self) -> list[ObservedWorld]:
        """The worlds whose free bodies hardly moved, watched again while these are thrown."""
        still = {name for world in self.worlds for name in _find_still(world)}
        if not still or not self.instance.accepts_seed or self.instance.context.budget.is_over():
            return []
        played = [self.logger.play_thrown(number, THROWN_STEPS, still) for number in THROWN_EPISODES]
        found = []
        for place, world in enumerate(self.worlds):
            logs = [logs[place] for logs in played if place in logs]
            joined = join_logs(dataclasses.replace(world, logs=logs))
            if joined is not None:
                found.append(ObservedWorld(world, *joined))
        return found


def _find_still(world: LoggedWorld) -> set[str]:
    """Return the names of free bodies without joints that hardly moved, or in few looks."""
    fastest: dict[str, float] = {}
    moving: collections.Counter[str] = collections.Counter()
    for log in world.logs:
        for body, states in log.bodies:
            if body.is_free and not body.joints:
                velocities = np.abs(states[:, VELOCITY])
                fastest[body.name] = max(fastest.get(body.name, 0.0), float(velocities.std(axis=0).max()))
                moving[body.name] += int((velocities > STILL).any(axis=1).sum())
    return {name for name, speed in fastest.items() if speed < STILL or moving[name] < FEWEST_MOVING}


@dataclasses.dataclass(frozen=True)
class MujocoTrials:
    """An instance in MuJoCo whose episodes repeat exactly, so that they show what something changes."""

    instance: Instance
    calls: MujocoCalls
    reader: MujocoStateReader
    plain: Sequence[Look]  # An episode in which nothing was changed
    found: Sequence[str]  # The ids of the rules with findings so far: one mistake is reported once


judges_models = JudgeHook[Any]()
"""Shows the environment after its first reset."""
judges_worlds = JudgeHook[WatchedWorlds]()
"""Shows all worlds, in which episodes have been played."""
judges_resets = JudgeHook[Instance]()
"""Shows an instance in MuJoCo that resets from equal seeds; parts may reset it."""
judges_trials = JudgeHook[MujocoTrials]()
"""Shows an instance in MuJoCo, with which the parts play episodes, by their places."""
judges_logs = JudgeHook[LoggedWorld]()
"""Shows each world at the end, when its bodies have also moved without the environment."""
_HOOKS = (judges_models, judges_worlds, judges_resets, judges_trials, judges_logs)


@experiment("worlds", INSTANCES, 20, share=4.0, hooks=_HOOKS, seeds_globals=True)
def watch_worlds(context: Context) -> Iterator[ChildMessage]:
    """Log the worlds of an instance through a few episodes, then let them fall alone, which may change them."""
    if not ENGINES & sys.modules.keys():
        with context.fresh():
            pass  # what it imports is imported now
    if not ENGINES & sys.modules.keys():
        raise NotApplicable("no world of PyBullet or MuJoCo")
    older, mujoco_calls = set(find_clients()), MujocoCalls()
    found: list[str] = []
    with _join(mujoco_calls), record_calls() as calls, context.fresh() as instance:
        with contextlib.suppress(EnvironmentRaised):  # the first episode raises it again
            instance.reset(FIRST_SEED)
        yield from judges_models.judge(instance.env)
        logger = WorldLogger(instance, older, calls, mujoco_calls)
        yield from _log_episodes(logger, context)
        bounds = [leaf.flat_bounds for leaf in instance.action_leaves if leaf.supported]
        low, high = (np.concatenate([pair[end] for pair in bounds] or [np.zeros(0)]) for end in (0, 1))
        watched = WatchedWorlds(instance, logger.worlds, calls, mujoco_calls, low, high, logger)
        for message in list(judges_worlds.judge(watched)):
            if isinstance(message, RuleFinding):
                found.append(message.rule)
            yield message
        yield from _try_mujoco(instance, mujoco_calls, logger.worlds, found)
        if logger.worlds and not context.budget.is_over():
            with contextlib.suppress(EnvironmentRaised):  # its resets were logged by now
                logger.simulate_alone(len(EPISODES))
    if not logger.resets:
        raise NotJudged("no episode could be logged")
    if not logger.worlds:
        raise NotApplicable("no world of PyBullet or MuJoCo")
    for world in logger.worlds:
        yield from judges_logs.judge(world)


def _join(calls: MujocoCalls) -> contextlib.AbstractContextManager[None]:
    return join_calls(calls) if "mujoco" in sys.modules else contextlib.nullcontext()


def _log_episodes(logger: WorldLogger, context: Context) -> Iterator[ChildMessage]:
    whole_s = context.budget.seconds_left
    for number, (kind, steps) in enumerate(EPISODES):
        if number and (not logger.worlds or context.budget.is_over()):
            return
        if number >= ENOUGH_EPISODES and context.budget.seconds_left < PART_FOR_THE_REST * whole_s:
            yield Shortened("worlds", f"{number} of {len(EPISODES)} logged episodes")
            return
        try:
            logger.play(number, kind, steps)
        except EnvironmentRaised as error:
            yield describe_failure(error, context.progress)


def _try_mujoco(
    instance: Instance, calls: MujocoCalls, worlds: Sequence[LoggedWorld], found: list[str]
) -> Iterator[ChildMessage]:
    readers = [world.reader for world in worlds if isinstance(world.reader, MujocoStateReader)]
    if not readers or instance.context.budget.is_over():
        return
    if not instance.accepts_seed:
        yield from _skip_trials("reset takes no seed (RL202)", found)
        return
    with contextlib.suppress(EnvironmentRaised):  # an episode that was logged raised it too
        yield from judges_resets.judge(instance)
        plain = play(instance, calls)
        plain = play(instance, calls)  # an instance's first episode may differ from all others
        if not are_equal(plain, play(instance, calls)):
            yield from _skip_trials("an episode with the same seed and actions is not the same again (RL302)", found)
            return
        trials = MujocoTrials(instance, calls, readers[0], plain, found)
        for message in judges_trials.judge(trials):
            if isinstance(message, RuleFinding):
                found.append(message.rule)
            yield message


def _skip_trials(reason: str, found: Sequence[str]) -> Iterator[Skipped]:
    """Say why the rules that compare repeated episodes were not judged, but for those that found something before."""
    for rule in judges_trials.decided:
        if rule not in found:
            yield Skipped(rule, reason)
