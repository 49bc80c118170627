"""Builds environments whose episodes can be drawn."""

import contextlib
import copy
from typing import Any

import gymnasium

from rlctl.environments import registry
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RlctlError
from rlctl.replaying.bullet_log import BulletLog, log_calls
from rlctl.replaying.scene import Env


class DrawableEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A plain environment whose calls of PyBullet are logged until it is closed."""

    def __init__(self, env: Env, log: BulletLog, stop: contextlib.ExitStack, no_pictures: str = "") -> None:
        super().__init__(env)
        self.bullet_log = log
        self.no_pictures = no_pictures  # why it cannot draw itself; empty if it might
        self._stop = stop

    def __deepcopy__(self, memo: dict[int, Any]) -> Env:
        """Return a copy of the environment alone, whose calls are not logged."""
        return copy.deepcopy(self.env, memo)

    def close(self) -> None:
        """Close the environment."""
        with self._stop:
            super().close()


def make_drawable(spec: EnvSpec) -> Env:
    """Build an environment whose episodes can be drawn."""
    with contextlib.ExitStack() as stack:
        log = stack.enter_context(log_calls())
        reason = ""
        if registry.is_task(spec.constructor()):
            return spec.make()  # its bodies are drawn; pictures would be slow and show less
        try:
            env = spec.make("rgb_array")
        except RlctlError as error:
            env = spec.make()  # raises again if drawing was not the reason
            reason = str(error).splitlines()[0]
        if not isinstance(env, gymnasium.Env):  # it has the same methods
            return env
        return DrawableEnv(env, log, stack.pop_all(), reason)
