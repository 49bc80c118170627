"""Playing a task with the actions of a policy server: `rlctl eval TASK --policy ws://...`, and a server's self-test."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from gymnasium import spaces

from rlctl.deploy.client import PolicyClient
from rlctl.errors import PolicyError, UsageError, short_repr
from rlctl.run.acting import Player
from rlctl.run.env_info import space_from_json


class RemotePlayer(Player):
    """Plays the actions of a policy server; reports its round trips and what the server said was wrong."""

    def __init__(self, url: str, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
        self._client = PolicyClient(url)
        self._action_space = action_space
        self._report: dict[str, Any] = {}
        env = self._client.metadata.get("env")
        if isinstance(env, dict) and (
            space_from_json(env["observation_space"]) != observation_space
            or space_from_json(env["action_space"]) != action_space
        ):
            raise UsageError(f"{url}: the policy that is served there is for other spaces than this task has")
        self._control_dt = self._client.metadata.get("control_dt")

    def act(self, observation: Any, seed: int, step: int) -> tuple[Any, Any]:
        request = dict(observation) if isinstance(observation, dict) else {"observation": observation}
        if step == 0:
            request["reset"] = True
            self._report = {"round_trips_s": [], "misses": 0, "not_running": 0}
        begin = time.perf_counter()
        answer = self._client.act(request)
        taken_s = time.perf_counter() - begin
        self._report["round_trips_s"].append(taken_s)
        self._report["misses"] += self._control_dt is not None and taken_s > self._control_dt
        self._report["not_running"] += answer.get("state", "running") != "running"
        if "error" in answer:
            raise PolicyError(f"{self._client.url}: {short_repr(answer['error'], 300)}")
        action = np.asarray(answer.get("actions"))[:1]
        shape = self._action_space.shape or ()
        if action.size != int(np.prod(shape)):
            raise PolicyError(f"{self._client.url}: actions of shape {action.shape}, the task takes {shape}")
        action = action.reshape(shape).astype(self._action_space.dtype)
        return action, action

    def close(self) -> None:
        """Close the connection."""
        self._client.close()

    def report(self) -> dict[str, Any]:
        return self._report
