"""The page on loopback: it is served with its WebSocket, gets the newest frame, and sends what the person does."""

import asyncio
import contextlib
import json
import threading
from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import aiohttp
import pydantic
from aiohttp import web

from rlctl.errors import UsageError, check_name
from rlctl_robot.play.controls import Controls, PageMessage
from rlctl_robot.serve.access import find_problem, is_websocket

_HOST = "127.0.0.1"
_LARGEST_MESSAGE = 64 * 1024  # [bytes]
_MOST_PAGES = 16
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; img-src data:"


class PageServer:
    """Serves the page from a thread; `show` and `describe` may be called from any other thread."""

    def __init__(self, port: int, controls: Controls) -> None:
        self._port, self._controls = port, controls
        self._page = (Path(__file__).parent / "page.html").read_text("utf-8")
        self._description = self._frame = "{}"
        self._commands: list[str] = []  # names of those that the page may set
        self._news: set[asyncio.Event] = set()  # one per page that is open
        self._loop = asyncio.new_event_loop()
        self._end = asyncio.Event()
        self._address: Future[str] = Future()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> str:
        """Start serving; return the address. Raises `UsageError` if the port is not free."""
        self._thread.start()
        return self._address.result()

    def close(self) -> None:
        """Stop serving."""
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(5.0)

    def describe(self, description: dict[str, Any]) -> None:
        """Show another episode: what stays the same in its frames."""
        self._description = json.dumps(description, allow_nan=False)
        self._commands = list(description["commands"])

    def show(self, frame: dict[str, Any]) -> None:
        """Show a frame; a page that is too slow gets the newest only."""
        self._frame = json.dumps(frame, allow_nan=False)
        self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        for news in self._news:
            news.set()

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        except BaseException as error:
            if self._address.done():
                raise
            self._address.set_exception(error)

    async def _serve(self) -> None:
        app = web.Application(middlewares=[_check_access], client_max_size=_LARGEST_MESSAGE)
        app.add_routes([web.get("/", self._answer)])
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
        await runner.setup()
        try:
            try:
                await web.TCPSite(runner, _HOST, self._port).start()
            except OSError as error:
                reason = f"{error.strerror or error}; --port 0 takes any free port"
                raise UsageError(f"--port {self._port}: {reason}") from None
            self._address.set_result(f"http://{_HOST}:{runner.addresses[0][1]}/")
            await self._end.wait()
        finally:
            await runner.cleanup()

    async def _answer(self, request: web.Request) -> web.StreamResponse:
        if not is_websocket(request):
            headers = {"Content-Security-Policy": _POLICY, "Cache-Control": "no-store"}
            return web.Response(text=self._page, content_type="text/html", headers=headers)
        if len(self._news) >= _MOST_PAGES:
            return web.json_response({"error": f"{_MOST_PAGES} pages are open already"}, status=503)
        socket = web.WebSocketResponse(compress=False, max_msg_size=_LARGEST_MESSAGE, heartbeat=20.0, timeout=1.0)
        await socket.prepare(request)
        sender = asyncio.create_task(self._send_frames(socket))
        try:
            async for message in socket:
                if message.type is aiohttp.WSMsgType.TEXT and (problem := self._read(message.data)):
                    await socket.send_json({"error": problem})
        finally:
            sender.cancel()
        return socket

    async def _send_frames(self, socket: web.WebSocketResponse) -> None:
        news, described = asyncio.Event(), ""
        self._news.add(news)
        try:
            with contextlib.suppress(ConnectionError):
                while True:
                    if described != self._description:
                        described = self._description
                        await socket.send_str(described)
                    await socket.send_str(self._frame)
                    await news.wait()
                    news.clear()
        finally:
            self._news.discard(news)

    def _read(self, text: str) -> str:
        """Read a message of the page; return what is wrong with it, or nothing."""
        try:
            message = PageMessage.model_validate_json(text)
            for name in message.commands or ():
                check_name(name, self._commands, "commands: no command", UsageError, listed="There is")
            self._controls.apply(message)
        except UsageError as error:
            return str(error)
        except pydantic.ValidationError as error:
            problem = error.errors()[0]
            key = ".".join(str(part) for part in problem["loc"])
            return f"{key}: {problem['msg']}" if key else str(problem["msg"])
        return ""


@web.middleware
async def _check_access(
    request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
) -> web.StreamResponse:
    if problem := find_problem(request, is_local=True, key=None):
        return web.json_response({"error": problem[1]}, status=problem[0])
    return await handler(request)
