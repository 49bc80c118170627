"""What a teacher sees of an environment that a student plays: the observations of its own spec."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium

from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings
from rlctl.task.observation import Observing
from rlctl.task.worlds import take_row

if TYPE_CHECKING:
    from gymnasium import spaces


class TeacherWrapper(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Observes for a teacher too: `seen` is its observation of the present step, of the space `teacher_space`.

    It is the innermost wrapper; those around it change the observations of the student only.
    """

    def __init__(
        self, env: gymnasium.Env[Any, Any], observing: Observing, events: EventSettings, wrap: Callable[[Any], Any]
    ) -> None:
        """`wrap` puts the teacher's wrappers around an environment."""
        super().__init__(env)
        inner = env.unwrapped
        if isinstance(inner, TaskEnv):
            sight = inner.worlds.show_teacher(observing, events)
            self.sizes = sight.view.sizes
            """Elements per name of what the teacher sees, without its wrappers; empty for a plain environment."""
            self._source = _Source(env, sight.view.space, lambda: take_row(sight.seen))
        else:
            self.sizes = {}
            self._source = _Source(env, env.observation_space, lambda: self._observation)
        self._wrapped = wrap(self._source)
        self.teacher_space = self._wrapped.observation_space
        self._observation: Any = None
        self.seen: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._observation = observation
        self.seen = self._wrapped.reset()[0]
        return observation, info

    def step(self, action: Any) -> Any:
        """Take a step."""
        result = self.env.step(action)
        self._observation = result[0]
        self.seen = self._wrapped.step(action)[0]
        return result


class _Source(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that is played elsewhere: returns what was observed there, for the wrappers around it."""

    def __init__(self, env: gymnasium.Env[Any, Any], space: spaces.Space[Any], read: Callable[[], Any]) -> None:
        super().__init__(env)
        self.observation_space = space
        self._read = read

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        """Return the first observation."""
        return self._read(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Return the next observation."""
        return self._read(), 0.0, False, False, {}


def find_teacher_wrapper(env: gymnasium.Env[Any, Any]) -> TeacherWrapper:
    """Return the `TeacherWrapper` of an environment that was made with a teacher."""
    while not isinstance(env, TeacherWrapper):
        assert isinstance(env, gymnasium.Wrapper)
        env = env.env
    return env


def strip_teacher_wrapper(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """Return an environment without a `TeacherWrapper` that is its outermost wrapper."""
    return env.env if isinstance(env, TeacherWrapper) else env
