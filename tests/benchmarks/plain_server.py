"""A policy server as openpi's is built: `websockets`, msgpack, the policy, and nothing else. `plain_server FILE`.

No limits, no checks of what comes in, no watchdog, log or measurements. Needs `pip install websockets`.
"""

from __future__ import annotations

import asyncio
import sys
import time
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from rlctl.policy.load import load_policy


def encode(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    raise TypeError(type(value))


def decode(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" in value:
        return np.ndarray(buffer=value[b"data"], dtype=np.dtype(value[b"dtype"]), shape=value[b"shape"])
    return value


async def answer(socket: ServerConnection) -> None:
    policy = load_policy(Path(sys.argv[1]))
    packer = msgpack.Packer(default=encode)
    await socket.send(packer.pack({}))
    before_s = None
    try:
        while True:
            begin = time.monotonic()
            request = msgpack.unpackb(await socket.recv(), object_hook=decode)
            begin_acting = time.monotonic()
            action = policy.predict(request["observation"])
            timing = {"infer_ms": (time.monotonic() - begin_acting) * 1e3}
            if before_s is not None:
                timing["prev_total_ms"] = before_s * 1e3
            await socket.send(packer.pack({"actions": action[None], "server_timing": timing}))
            before_s = time.monotonic() - begin
    except ConnectionClosed:
        return


async def main() -> None:
    async with serve(answer, "127.0.0.1", 0, compression=None, max_size=None) as server:
        print(f"ws://127.0.0.1:{server.sockets[0].getsockname()[1]}", flush=True)
        await server.serve_forever()


if __name__ == "__main__":
    asyncio.run(main())
