"""One world in which competitors play: its episodes, its commands, and a script that moves bodies in it."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.instance import Instance
from rlctl.checking.rewards import DISCOUNT
from rlctl.environments.gym_worlds import GymWorlds
from rlctl.play.playing import Played, Playing
from rlctl.policy.actor import Actor, Rows
from rlctl.task.commands import CommandTerm
from rlctl.task.env import TaskEnv
from rlctl.task.joints import Joints
from rlctl.task.sim import Sim

Array = NDArray[np.float64]
MOST_STEPS = 1000  # of an episode
VELOCITIES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")  # forwards, to the left [m/s], turning to the left [rad/s]
COMMANDED = ((0.8, 0.0, 0.0), (0.6, 0.6, 0.6), (-0.8, 0.0, -0.6), (0.5, -0.8, 0.0))
"""What is commanded in each round, as parts of the largest velocities: in none of them standing still is right."""
_ROW = np.zeros(1, np.int64)


@dataclasses.dataclass(frozen=True)
class PlayedEpisode:
    """What an episode of a competitor has earned."""

    competitor: str
    seed: int
    steps: int
    reward: float  # the sum
    discounted: float  # the sum, discounted by `DISCOUNT`
    terms: Mapping[str, float]  # sums of the weighted terms
    success: bool | None  # at the end
    is_terminated: bool


@dataclasses.dataclass
class Script:
    """How a competitor plays one episode."""

    actor: Actor
    start: Callable[[], None] | None = None  # after the reset
    before: Callable[[int], None] | None = None  # before each step, whose number from 1 it is given
    move: Callable[[int], None] | None = None  # after the physics of each step, whose number from 1 it is given
    world: "PlayWorld | None" = None  # where it is not played in the common one
    accepts: Callable[[PlayedEpisode], bool] = lambda played: True
    """Whether an episode shows what the competitor is called: a fall that ends nothing is no fall."""


class PlayWorld:
    """One world of an environment."""

    def __init__(self, instance: Instance) -> None:
        self.instance = instance
        env = instance.env
        inner = getattr(env, "unwrapped", env)
        self.task_env: TaskEnv | None = inner if isinstance(inner, TaskEnv) else None
        is_bare = self.task_env is not None and env is inner
        self.worlds: Any = self.task_env.worlds if self.task_env is not None and is_bare else GymWorlds(env)
        self._playing = Playing(self.worlds)

    @property
    def space(self) -> Any:
        """The action space."""
        return self.worlds.action_space

    @property
    def sim(self) -> Sim | None:
        """The simulation of a task, whose arrays have no leading axis; None for any other environment."""
        return None if self.task_env is None else self.task_env.worlds.sim_of(0)

    @property
    def control_dt(self) -> float:
        """Time of a step of a task [s]."""
        assert self.task_env is not None
        return float(self.task_env.task.control_dt)

    @property
    def longest(self) -> int:
        """The most steps that an episode is played."""
        limit = self.instance.max_steps
        return MOST_STEPS if limit is None else min(limit, MOST_STEPS)

    @property
    def has_success(self) -> bool:
        """Whether a task says when it is a success."""
        return self.task_env is not None and self.task_env.worlds.has_success

    def begin(self, seed: int, number: int) -> Any:
        """Begin the episode of a seed, with the commands of a round; return the first observation, shape (1, ...)."""
        self.instance.progress.episode(0, seed)
        self._playing = Playing(self.worlds)
        observation = self.instance.call("reset", self._playing.begin, _ROW, [seed])
        self.ask(lambda: self._set_commands(number))
        return observation

    def _set_commands(self, number: int) -> None:
        commands = choose_commands(self.read_commands(), number)
        if commands:
            assert self.task_env is not None
            self.task_env.set_commands(commands)

    def ask(self, question: Callable[[], Any]) -> Any:
        """Return what a function returns that calls code of the task; its exceptions are `EnvironmentRaised`."""
        return self.instance.call("reset", question)

    def read_commands(self) -> dict[str, CommandTerm]:
        """Return what a task may be commanded, by name; outside of a step call it by `ask`, as all below."""
        return {} if self.task_env is None else self.task_env.commands()

    def read_joints(self) -> Joints | None:
        """Return the joints that an action moves; None where a task does not say, and for other environments."""
        if self.task_env is None:
            return None
        joints: Joints | None = self.task_env.task.describe_joints()
        return joints

    def read_velocity(self) -> Array | None:
        """Return the commanded velocity [m/s, m/s, rad/s], shape (3,); None for a task that commands none."""
        commands = self.read_commands()
        if not commands.keys() & {*VELOCITIES}:
            return None
        return np.array([float(commands[name].value) if name in commands else 0.0 for name in VELOCITIES])

    def play(self, script: Script, competitor: str, seed: int, number: int, longest: int) -> PlayedEpisode:
        """Play an episode of a competitor, of at most `longest` steps."""
        observation = self.begin(seed, number)
        if script.start is not None:
            self.ask(script.start)
        script.actor.begin(Rows.one(seed))
        steps = self._playing.play(script.actor, _ROW, observation)
        discounted, played = 0.0, None
        self._set_move(script.move)
        try:
            for step in range(longest):
                if script.before is not None:
                    self.ask(functools.partial(script.before, step + 1))
                taken: Played | None = self.instance.call("step", next, steps, None, step=step + 1)
                if taken is None:
                    break
                played = taken
                discounted += DISCOUNT**step * float(taken.result.reward[0])
        finally:
            self._set_move(None)
        totals = self.worlds.totals(0)
        is_terminated = played is not None and bool(played.result.terminated[0])
        return PlayedEpisode(
            competitor,
            seed,
            int(self.worlds.step_of[0]),
            float(totals.reward),
            discounted,
            dict(totals.terms),
            totals.success,
            is_terminated,
        )

    def _set_move(self, move: Callable[[int], None] | None) -> None:
        if self.task_env is None:
            return
        worlds = self.task_env.worlds
        worlds.after_physics = None if move is None else lambda: move(int(worlds.step_of[0]))


def choose_commands(commands: Mapping[str, CommandTerm], number: int) -> dict[str, Any]:
    """Return the velocities of a round, of those that may be commanded; see `COMMANDED`."""
    parts = dict(zip(VELOCITIES, COMMANDED[number % len(COMMANDED)], strict=True))
    chosen = {}
    for name, part in parts.items():
        if name in commands:
            low, high = float(commands[name].low), float(commands[name].high)
            limit = low if part < 0 and low < 0 else high
            chosen[name] = min(max(abs(part) * limit, low), high)
    return chosen
