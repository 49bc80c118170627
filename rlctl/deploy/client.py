"""A client of policy servers: actions for observations, one after the other."""

from __future__ import annotations

import asyncio
import os
from typing import Any

import aiohttp

from rlctl.deploy import messages
from rlctl.deploy.serve import KEY_VARIABLE
from rlctl.errors import PolicyError, UsageError, short_repr

_TIMEOUT_S = 10.0
_LARGEST = 16 * 2**20  # [bytes] of an answer


class PolicyClient:
    """A connection to a policy server; `act` waits for each answer. The key is that of the environment, if any.

    Raises `UsageError` if no server answers, `PolicyError` for what is not an answer.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self._loop = asyncio.new_event_loop()
        key = os.environ.get(KEY_VARIABLE)
        self._headers = {"Authorization": f"Api-Key {key.strip()}"} if key else {}
        self.metadata: dict[str, Any] = self._run(self._connect())
        """What the server says of its policy."""

    def _run(self, call: Any) -> Any:
        return self._loop.run_until_complete(call)

    async def _connect(self) -> dict[str, Any]:
        try:
            self._session = aiohttp.ClientSession(headers=self._headers)
            self._socket = await self._session.ws_connect(
                self.url, compress=0, max_msg_size=_LARGEST, timeout=aiohttp.ClientWSTimeout(ws_close=1.0)
            )
            return self._unpack(await self._socket.receive(_TIMEOUT_S))
        except (aiohttp.ClientError, OSError, ValueError) as error:
            await self._session.close()
            raise UsageError(f"{self.url}: no policy server answers: {short_repr(str(error) or type(error))}") from None

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
            raise PolicyError(f"{self.url}: a {type(content).__name__}, not an answer")
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
            raise PolicyError(f"{self.url}: the connection is lost: {short_repr(str(error))}") from None

    def close(self) -> None:
        """Close the connection."""
        self._run(self._socket.close())
        self._run(self._session.close())
        self._loop.close()
