"""`rlctl serve`: find the policy, check everything before the first client, and serve until a signal."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rlctl.errors import RlctlError, UsageError, explain_missing_package
from rlctl.limits.limits import NO_LIMITS, read_limits
from rlctl_robot.serve.serve_request import ServeRequest
from rlctl_robot.serve.session import load_served_policy

if TYPE_CHECKING:
    from rlctl_robot.serve.server import PolicyServer


def make_server(file: Path, request: ServeRequest) -> PolicyServer:
    """Load a policy and make its server. Raises `RlctlError` for an invalid policy, limits file, key or option."""
    try:
        import uvloop  # noqa: F401

        from rlctl_robot.serve.access import find_key
        from rlctl_robot.serve.server import PolicyServer
    except ModuleNotFoundError as error:
        raise UsageError(explain_missing_package("rlctl serve", error.name, "serve")) from None
    key = find_key(request.host, request.key_file)
    limits = NO_LIMITS if request.limits is None else read_limits(request.limits)
    if not request.watchdog:
        limits = limits.model_copy(update={"watchdog_periods": 0.0})
    return PolicyServer(load_served_policy(file), request, limits, key)


def run_server(server: PolicyServer, on_start: Callable[[str], None]) -> None:
    """Serve until SIGINT or SIGTERM; SIGHUP reads the policy file again. Calls `on_start` with the address."""
    with asyncio.Runner(loop_factory=make_loop) as runner:
        runner.run(serve_until(server, on_start, asyncio.Event(), handle_signals=True))


def make_loop() -> asyncio.AbstractEventLoop:
    """Return a loop for a server: uvloop's, which answers a quarter faster than asyncio's own."""
    import uvloop

    return uvloop.new_event_loop()


async def serve_until(
    server: PolicyServer, on_start: Callable[[str], None], end: asyncio.Event, *, handle_signals: bool = False
) -> None:
    """Serve until `end` is set."""
    from aiohttp import web

    from rlctl_robot.serve.routes import BACKLOG, Connections, Routes, count_allowed_connections

    request = server.request
    logging.getLogger("aiohttp.server").addFilter(_is_worth_a_traceback)
    connections = Connections(count_allowed_connections(request.max_clients))
    app = Routes(server, connections).make_app()
    # A small body could decompress to gigabytes, and stops would wait: `Routes` refuses compressed ones.
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0, auto_decompress=False)
    await runner.setup()
    web_server = runner.server
    assert web_server is not None
    loop = asyncio.get_running_loop()
    try:
        try:
            listener = await loop.create_server(
                lambda: connections.accept(web_server()), request.host, request.port, backlog=BACKLOG
            )
        except OSError as error:
            reason = f"{error.strerror or error}; --port 0 takes any free port"
            raise UsageError(f"--host {request.host} --port {request.port}: {reason}") from None
        with contextlib.closing(listener):
            if handle_signals:
                _handle_signals(server, end)
            gc.collect()
            gc.freeze()  # these objects stay until the end: the garbage collector can skip them
            port = listener.sockets[0].getsockname()[1]
            host = f"[{request.host}]" if ":" in request.host else request.host
            on_start(f"{host}:{port}")
            await end.wait()
    finally:
        await runner.cleanup()


def _is_worth_a_traceback(record: logging.LogRecord) -> bool:
    """Return whether to log an error; invalid HTTP requests are answered with 400 and not logged."""
    from aiohttp.http_exceptions import HttpProcessingError

    return not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError))


def _handle_signals(server: PolicyServer, end: asyncio.Event) -> None:
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, end.set)
    file, task = server.policy.file, None

    def reload() -> None:
        nonlocal task  # the loop itself keeps only a weak reference to a task
        task = loop.create_task(_reload(server, file))

    loop.add_signal_handler(signal.SIGHUP, reload)


async def _reload(server: PolicyServer, file: Path) -> None:
    try:
        await server.replace_policy(file)
        print(f"reloaded {file}: step {server.policy.info.training_steps:,}", file=sys.stderr)
    except RlctlError as error:
        print(f"warning: the policy was not changed: {error}", file=sys.stderr)
