"""A game in a thread, and a page without a browser."""

import asyncio
import contextlib
import json
import threading
import time

import aiohttp

from rlctl.replaying.drawable import make_drawable
from rlctl.replaying.replay_request import ReplayRequest
from rlctl.replaying.sources import PolicySource
from rlctl_robot.play.controls import Controls
from rlctl_robot.play.page_server import PageServer
from rlctl_robot.play.play import Game


class Page:
    """Receives what the server sends, one message after the other."""

    def __init__(self, address):
        self._loop = asyncio.new_event_loop()
        self._address = address
        self.about = {}
        self._run(self._connect())

    def _run(self, call):
        return self._loop.run_until_complete(call)

    async def _connect(self):
        self._session = aiohttp.ClientSession()
        self._socket = await self._session.ws_connect(self._address, max_msg_size=0)

    def send(self, **message):
        self._run(self._socket.send_str(json.dumps(message)))

    def receive(self):
        return json.loads(self._run(self._socket.receive(10)).data)

    def wait_for(self, condition):
        """Return the first frame for which a condition holds."""
        end = time.monotonic() + 10
        while time.monotonic() < end:
            message = self.receive()
            if "parts" in message:
                self.about = message
            elif "error" in message or ("poses" in message and condition(message)):
                return message
        raise AssertionError("no such frame")

    def close(self):
        self._run(self._socket.close())
        self._run(self._session.close())
        self._loop.close()


@contextlib.contextmanager
def play(task, *, sim=None, output=None, record=False):
    """Play the shipped policy of a task; yields the page, and the list of results, which is filled at the end."""
    source = PolicySource(ReplayRequest(task, checkpoint="pretrained", sim=sim, output=output))
    spec = source.spec.as_deployed()
    controls, results = Controls(record=record), []
    server = PageServer(0, controls)
    address = server.start()
    failures = []

    def run():
        try:
            with contextlib.closing(make_drawable(spec)) as env:
                results.append(Game(env, spec, source, controls, server).play(0))
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    page = Page(address)
    try:
        yield page, results
    finally:
        controls.stop()
        thread.join(30)
        page.close()
        server.close()
    assert failures == []
