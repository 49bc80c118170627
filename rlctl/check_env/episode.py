"""Plays one episode of an environment that is not trusted: the only place that resets and steps in a loop."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from rlctl.check_env.actions import actions
from rlctl.check_env.clock import read_clock
from rlctl.check_env.failures import EnvironmentRaised
from rlctl.check_env.instance import Instance
from rlctl.check_env.leaves import name_type, read_flag


@dataclasses.dataclass(frozen=True)
class Moment:
    """What one call of reset or step was given and returned."""

    step: int
    """0 is the reset."""
    action: Any
    observation: Any
    reward: Any = 0.0
    terminated: Any = False
    truncated: Any = False
    info: Any = dataclasses.field(default_factory=dict)
    form: str = ""
    """What was returned where it is not what Gymnasium's interface says: `tuple of 4`, `NoneType`."""
    is_readable: bool = True
    """False where step returned something that cannot be taken apart: nothing above it is known."""

    @property
    def flags(self) -> tuple[bool, bool]:
        """What `terminated` and `truncated` mean, whatever their types."""
        return read_flag(self.terminated), read_flag(self.truncated)


class Episode:
    """One episode. Iterating over it resets, and steps until it ends or must end; each call is a `Moment`.

    Where the environment raises, iterating raises `EnvironmentRaised`. `reset` and `step` may be called directly too.
    """

    def __init__(
        self,
        instance: Instance,
        seed: int,
        actions: str = "random",
        *,
        number: int = 0,
        action_seed: int | None = None,
        max_steps: int = 10_000,
        deadline: float = float("inf"),
        given: Iterable[Any] | None = None,
        timer: Callable[..., Any] | None = None,
    ) -> None:
        """`actions` is a kind (see `check_env.actions`), drawn with `action_seed`, else with `seed`; or the name of
        those that are `given`. `deadline` is on `read_clock`'s clock [s]. `timer` calls the environment's functions
        for us."""
        self.instance = instance
        self.seed = seed
        self.number = number
        self.max_steps = max_steps
        self.deadline = deadline
        self.steps = 0
        self.ended = ""
        """`terminated`, `truncated`, `both`, `raised`, or what cut it: `steps`, `time`; empty while it goes on."""
        self._timer = timer
        self.actions = actions
        self._given = given
        self._action_seed = seed if action_seed is None else action_seed
        self._next = iter(self._choose_actions())

    def __iter__(self) -> Iterator[Moment]:
        yield self.reset()
        while not self.ended:
            yield self.step()

    def reset(self) -> Moment:
        """Begin the episode."""
        self.steps, self.ended = 0, "" if self.max_steps else "steps"
        self._next = self._choose_actions()
        try:
            returned = self.instance.reset(self.seed, self.number, timer=self._timer)
        except EnvironmentRaised:
            self.ended = "raised"
            raise
        if isinstance(returned, tuple) and len(returned) == 2:
            return Moment(0, None, returned[0], info=returned[1])
        return Moment(0, None, returned, form=_form(returned))

    def _choose_actions(self) -> Iterator[Any]:
        if self._given is not None:
            return iter(self._given)
        return actions(self.instance.env.action_space, self.actions, self._action_seed)

    def step(self) -> Moment:
        """Take one step."""
        self.steps += 1
        call, env = self.instance.call, self.instance.env
        try:
            action = call("sample", next, self._next, step=self.steps)
            timed = (self._timer, env.step, action) if self._timer else (env.step, action)
            returned = call("step", *timed, step=self.steps)
        except EnvironmentRaised:
            self.ended = "raised"
            raise
        moment = self._read(action, returned)
        terminated, truncated = moment.flags
        if not moment.is_readable:
            self.ended = "raised"
        elif terminated or truncated:
            self.ended = "both" if terminated and truncated else "terminated" if terminated else "truncated"
        elif self.steps >= self.max_steps:
            self.ended = "steps"
        elif read_clock() > self.deadline:
            self.ended = "time"
        return moment

    def _read(self, action: Any, returned: Any) -> Moment:
        if isinstance(returned, tuple) and len(returned) == 5:
            return Moment(self.steps, action, *returned)
        form = _form(returned)
        if isinstance(returned, tuple) and len(returned) == 4:
            observation, reward, done, info = returned
            return Moment(self.steps, action, observation, reward, done, False, info, form)
        return Moment(self.steps, action, None, form=form, is_readable=False)


def _form(returned: Any) -> str:
    return name_type(returned) + (f" of {len(returned)}" if isinstance(returned, tuple) else "")
