"""A client of policy servers, and the actor that `rlctl eval TASK --policy ws://...` and the self-test use."""

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
from rlctl.policy.actor import Actor, Array, Rows, act_one_by_one

_TIMEOUT_S = 10.0
_MAX_ANSWER = 16 * 2**20  # [bytes]


class PolicyClient:
    """A connection to a policy server; `ask` waits for each answer. Sends the key in `RLCTL_API_KEY`, if it is set.

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

    def ask(self, request: dict[str, Any]) -> dict[str, Any]:
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


class RemoteActor(Actor):
    """Takes the actions of a policy server; reports round-trip times, late answers, and faults.

    Each row has a connection of its own, because the server keeps an episode per connection.
    """

    def __init__(self, url: str, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
        first = PolicyClient(url)
        self._url, self._spare = url, [first]
        self._clients: dict[int, PolicyClient] = {}  # by row
        self._begins: set[int] = set()  # rows whose episode begins with the next request
        self._action_space = action_space
        self._reports: dict[int, dict[str, Any]] = {}
        env = first.metadata.get("env")
        own = {"observation_space": observation_space, "action_space": action_space}
        if isinstance(env, dict) and any(key in env and space_from_json(env[key]) != own[key] for key in own):
            first.close()
            raise UsageError(f"{url}: the served policy has other observation or action spaces than this task")
        dt = first.metadata.get("control_dt")
        self._control_dt = dt if isinstance(dt, int | float) else math.inf

    def begin(self, rows: Rows) -> None:
        """Let the next requests begin episodes."""
        for row in rows.index.tolist():
            if row not in self._clients:
                self._clients[row] = self._spare.pop() if self._spare else PolicyClient(self._url)
            self._begins.add(row)
            self._reports[row] = {"round_trips_s": [], "misses": 0, "not_running": 0}

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the server's actions, to record and to step with. Raises `PolicyError` for an invalid one."""
        return act_one_by_one(observations, rows, self._ask)

    def _ask(self, observation: Any, row: int, seed: int, step: int) -> Any:
        client, report = self._clients[row], self._reports[row]
        request = dict(observation) if isinstance(observation, dict) else {"observation": observation}
        if row in self._begins:
            self._begins.remove(row)
            request["reset"] = True
        begin = time.perf_counter()
        answer = client.ask(request)
        round_trip_s = time.perf_counter() - begin
        report["round_trips_s"].append(round_trip_s)
        report["misses"] += round_trip_s > self._control_dt
        report["not_running"] += answer.get("state", "running") != "running"
        if "error" in answer:
            raise PolicyError(f"{self._url}: {short_repr(answer['error'], 300)}")
        values, shape = answer.get("actions"), self._action_space.shape or ()
        try:
            return np.asarray(values, self._action_space.dtype)[:1].reshape(shape)
        except (ValueError, TypeError, IndexError, OverflowError):
            raise PolicyError(
                f"{self._url}: actions are {short_repr(values)}, expected a list of one action, shape {shape}"
            ) from None

    def close(self) -> None:
        """Close the connections."""
        for client in (*self._clients.values(), *self._spare):
            client.close()

    def report(self, row: int) -> dict[str, Any]:
        """Return the episode's round-trip times [s], how many exceeded `control_dt`, and answers not `running`."""
        return self._reports[row]
