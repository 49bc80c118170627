"""One environment that is not trusted, how it is called, and how much time and memory its episodes may take."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from rlctl.check_env.clock import read_clock
from rlctl.check_env.failures import EnvironmentRaised
from rlctl.check_env.leaves import Leaf
from rlctl.check_env.progress import Progress


@dataclasses.dataclass
class Budget:
    """What the episodes of an experiment may use together."""

    deadline: float
    """On `read_clock`'s clock [s]."""
    bytes_left: int = 48 * 2**20

    @property
    def seconds_left(self) -> float:
        return self.deadline - read_clock()

    def end_within(self, seconds: float) -> float:
        """Return when something that may take so long ends at the latest, on the same clock [s]."""
        return min(read_clock() + seconds, self.deadline)


class Instance:
    """One environment, and how it is called."""

    def __init__(
        self, env: Any, leaves: list[Leaf], action_leaves: list[Leaf], accepts_seed: bool, progress: Progress
    ) -> None:
        self.env = env
        self.leaves = leaves
        self.action_leaves = action_leaves
        self.accepts_seed = accepts_seed
        self.progress = progress

    @property
    def is_env(self) -> bool:
        """Whether it inherits from `gymnasium.Env`."""
        import gymnasium

        return isinstance(self.env, gymnasium.Env)

    @property
    def can_act(self) -> bool:
        """Whether its action space is one of Gymnasium's, from which actions can be drawn."""
        from gymnasium import spaces

        return isinstance(self.env.action_space, spaces.Space)

    def call(self, name: str, function: Any, *arguments: Any, step: int = 0, **keywords: Any) -> Any:
        """Call into the environment; whatever it raises, `SystemExit` included, is an `EnvironmentRaised`."""
        self.progress.enter(name, step)
        try:
            return function(*arguments, **keywords)
        except BaseException as error:
            raise EnvironmentRaised(name) from error
        finally:
            self.progress.leave()

    def reset(self, seed: int, episode: int = 0, timer: Callable[..., Any] | None = None) -> Any:
        """Reset with a seed, where reset takes one, and return what it returns."""
        self.progress.episode(episode, seed)
        keywords = {"seed": seed} if self.accepts_seed else {}
        timed = (timer, self.env.reset) if timer else (self.env.reset,)
        return self.call("reset", *timed, **keywords)

    def close(self) -> None:
        """Close the environment."""
        self.call("close", self.env.close)
