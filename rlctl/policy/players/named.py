"""Players by name: zero and random actions, exported files, functions that a user writes."""

from pathlib import Path
from typing import Any

from gymnasium import spaces

from rlctl.policy.c_policy import LIBRARY_SUFFIX, CPolicy
from rlctl.policy.numpy_policy import load_policy
from rlctl.policy.players.baselines import FunctionPlayer, RandomPlayer, ZeroPlayer
from rlctl.policy.players.player import Player

SERVER = ("ws://", "wss://")
"""Prefixes of the address of a policy server; its player is `rlctl.deploy.server.client.RemotePlayer`."""


def make_player(name: str, space: spaces.Space[Any]) -> Player:
    """Return the player for `zero`, `random`, an exported file, or a function as `load_function` takes it."""
    if name == "zero":
        return ZeroPlayer(space)
    if name == "random":
        return RandomPlayer(space)
    return FunctionPlayer(name, space) if ":" in Path(name).name else ExportedPlayer(name)


class ExportedPlayer(Player):
    """Plays the deterministic action of an exported policy, an ONNX file or compiled C."""

    def __init__(self, path: str) -> None:
        self._policy = CPolicy.load(Path(path)) if path.endswith(LIBRARY_SUFFIX) else load_policy(Path(path))

    def act(self, observation: Any, seed: int, step: int) -> tuple[Any, Any]:
        """Return the deterministic action; step 0 resets a recurrent policy."""
        if step == 0:
            self._policy.reset()
        action = self._policy.predict(observation)
        return action, action
