"""A client of policy servers, and the player that `rlctl eval TASK --policy ws://...` and the self-test use."""

import asyncio
import math
import os
import time
from typing import Any

import aiohttp
import numpy as np
from gymnasium import spaces

from rlctl.environments.info import space_from_json
from rlctl.errors import PolicyError, UsageError, describe_exception, short_repr
from rlctl.options import KEY_VARIABLE
from rlctl.play import remote_messages as messages
from rlctl.policy.players.player import Player

_TIMEOUT_S = 10.0
_MAX_ANSWER = 16 * 2**20  # [bytes]


class PolicyClient:
    """A connection to a policy server; `act` waits for each answer. Sends the key in `RLCTL_API_KEY`, if it is set.

    Raises `UsageError` if no server answers, `PolicyError` for an invalid answer.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self._loop = asyncio.new_event_loop()
        key = os.environ.get(KEY_VARIABLE)
        self._headers = {"Authorization": f"Api-Key {key.strip()}"} if key else {}
        self.metadata: dict[str, Any] = self._run(self._connect())  # the server's description of its policy

    def _run(self, call: Any) -> Any:
        return self._loop.run_until_complete(call)

    async def _connect(self) -> dict[str, Any]:
        try:
            self._session = aiohttp.ClientSession(headers=self._headers)
            self._socket = await self._session.ws_connect(
                self.url, compress=0, max_msg_size=_MAX_ANSWER, timeout=aiohttp.ClientWSTimeout(ws_close=1.0)
            )
            return self._unpack(await self._socket.receive(_TIMEOUT_S))
        except (aiohttp.ClientError, OSError, ValueError) as error:
            await self._session.close()
            raise UsageError(f"{self.url}: no policy server answers: {describe_exception(error)}") from None
        except PolicyError:
            await self._session.close()
            raise

    def _unpack(self, message: aiohttp.WSMessage) -> dict[str, Any]:
        if message.type is aiohttp.WSMsgType.TEXT:
            raise PolicyError(f"{self.url}: {short_repr(message.data, 300)}")
        if message.type is not aiohttp.WSMsgType.BINARY:
            raise PolicyError(f"{self.url}: the server has closed the connection")
        try:
            content = messages.unpack(message.data)
        except messages.MessageError as error:
            raise PolicyError(f"{self.url}: {error}") from None
        if not isinstance(content, dict):
            raise PolicyError(f"{self.url}: the server sent a {type(content).__name__}, expected a map")
        return content

    def act(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send an observation by name and return the answer; its `actions` have shape (1, ...)."""
        return self.send(messages.pack(request))

    def send(self, content: bytes) -> dict[str, Any]:
        """Send a message as bytes and return the answer."""
        return self._unpack(self._run(self._exchange(content)))

    async def _exchange(self, content: bytes) -> aiohttp.WSMessage:
        try:
            await self._socket.send_bytes(content)
            return await self._socket.receive(_TIMEOUT_S)
        except (aiohttp.ClientError, OSError) as error:
            raise PolicyError(f"{self.url}: connection lost: {describe_exception(error)}") from None

    def close(self) -> None:
        """Close the connection."""
        self._run(self._socket.close())
        self._run(self._session.close())
        self._loop.close()


class RemotePlayer(Player):
    """Plays the actions of a policy server; reports round-trip times, late answers, and faults."""

    def __init__(self, url: str, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
        self._client = PolicyClient(url)
        self._action_space = action_space
        self._report: dict[str, Any] = {}
        env = self._client.metadata.get("env")
        own = {"observation_space": observation_space, "action_space": action_space}
        if isinstance(env, dict) and any(key in env and space_from_json(env[key]) != own[key] for key in own):
            self._client.close()
            raise UsageError(f"{url}: the served policy has other observation or action spaces than this task")
        dt = self._client.metadata.get("control_dt")
        self._control_dt = dt if isinstance(dt, int | float) else math.inf

    def act(self, observation: Any, seed: int, step: int) -> tuple[Any, Any]:
        """Return the server's action twice, to record and to step with. Raises `PolicyError` for an invalid one."""
        request = dict(observation) if isinstance(observation, dict) else {"observation": observation}
        if step == 0:
            request["reset"] = True
            self._report = {"round_trips_s": [], "misses": 0, "not_running": 0}
        begin = time.perf_counter()
        answer = self._client.act(request)
        round_trip_s = time.perf_counter() - begin
        self._report["round_trips_s"].append(round_trip_s)
        self._report["misses"] += round_trip_s > self._control_dt
        self._report["not_running"] += answer.get("state", "running") != "running"
        if "error" in answer:
            raise PolicyError(f"{self._client.url}: {short_repr(answer['error'], 300)}")
        values, shape = answer.get("actions"), self._action_space.shape or ()
        try:
            action = np.asarray(values, self._action_space.dtype)[:1].reshape(shape)
        except (ValueError, TypeError, IndexError, OverflowError):
            raise PolicyError(
                f"{self._client.url}: actions are {short_repr(values)}, expected a list of one action, shape {shape}"
            ) from None
        return action, action

    def close(self) -> None:
        """Close the connection."""
        self._client.close()

    def report(self) -> dict[str, Any]:
        """Return this episode's round-trip times [s], how many exceeded `control_dt`, and answers not `running`."""
        return self._report
