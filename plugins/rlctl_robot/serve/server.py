"""A policy server: openpi's WebSocket protocol, JSON over HTTP, orders, metrics and a live page, on one port."""

import asyncio
import collections
import dataclasses
import functools
import itertools
import math
import time
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
from aiohttp import web
from gymnasium import spaces

from rlctl import output
from rlctl.errors import RlctlError, short_repr
from rlctl.limits.bounds import SafetyEvent
from rlctl.limits.limits import Limits
from rlctl.limits.observation import ObservationReader
from rlctl.play import remote_messages as messages
from rlctl.version import __version__
from rlctl_robot.serve.records import EventLog, Measurements, RerunLog
from rlctl_robot.serve.serve_request import ServeRequest
from rlctl_robot.serve.session import ServedPolicy, Session, load_served_policy

_HEARTBEAT_S = 30.0
_NO_WAIT_S = 20e-6
_MIN_TICK_S = 0.01


class PolicyServer:
    """Serves one policy to many clients; each WebSocket connection is an episode with a filter of its own."""

    def __init__(self, policy: ServedPolicy, request: ServeRequest, limits: Limits, api_key: str | None) -> None:
        self.request, self.api_key = request, api_key
        self.policy = policy
        self.measurements = Measurements()
        self._log = EventLog(request.log)
        self._recording = None if request.rerun is None else RerunLog(request.rerun)
        self._numbers = itertools.count(1)
        self._sessions: dict[int, Session] = {}
        self._earlier_counts: collections.Counter[str] = collections.Counter()
        self._manual: Any | None = None  # the action of an override; None: the policy acts
        self._order: str | None = None  # the operator's last order, which later clients get too; None: no order
        self._limits = limits
        self._began_s = time.monotonic()
        shapes = ObservationReader(policy.info.env).shapes
        self.largest_message = 64 * sum(map(math.prod, shapes.values())) + 64 * 1024  # text with names
        """Largest size of a request [bytes]."""
        # The first answer of a process is slow, because libraries load modules for it: no robot shall wait for that.
        Session(0, lambda: policy, limits).answer({name: np.zeros(shape) for name, shape in shapes.items()})
        self._log.write("started", rlctl=__version__, limits=str(request.limits or ""), **_describe_policy(policy))
        self.posting = self._open_session()  # the session of clients that post

    @property
    def metadata(self) -> dict[str, Any]:
        """The first message to a client: names, sizes, units and bounds of observations and actions, timing."""
        info = self.policy.info
        return {
            "server": f"rlctl {__version__}",
            "task": info.spec.task,
            "algo": info.algo,
            "policy": self.policy.file.name,
            "training_steps": info.training_steps,
            "control_dt": self.posting.safety.control_dt,
            "observation": {name: list(shape) for name, shape in self.posting.safety.reader.shapes.items()},
            "observation_units": dict(info.env.observation_units),
            "action_meaning": info.env.action_meaning,
            "env": info.env.model_dump(mode="json"),
            "limits": self._limits.model_dump(mode="json", exclude_defaults=True),
        }

    def _open_session(self) -> Session:
        session = Session(next(self._numbers), lambda: self.policy, self._limits)
        if self.request.log is not None:
            session.safety.on_event = functools.partial(self._log.write_event, session.number)
        self._sessions[session.number] = session
        self._log.write("connected", session.number)
        if self._order is not None:
            session.order(self._order)
        session.safety.override(self._manual)
        return session

    def _close_session(self, session: Session) -> None:
        self._sessions.pop(session.number, None)
        self._earlier_counts.update(session.safety.counts)
        self._log.write("disconnected", session.number, name=session.safety.state, steps=session.safety.steps)

    def count_interventions(self) -> collections.Counter[str]:
        """Return the number of interventions per limit and of faults, over all clients so far."""
        return sum((session.safety.counts for session in self._sessions.values()), self._earlier_counts)

    def _write_fault(self, session: Session, name: str, value: float | str, limit: float | None = None) -> None:
        self._log.write_event(session.number, SafetyEvent(time.time(), "fault", name, value, limit))

    def close(self) -> None:
        """Close the log and the recording."""
        self._log.write("ended")
        self._log.close()
        if self._recording is not None:
            self._recording.close()

    async def write_recording(self) -> None:
        """Write the recorded rows once per second; runs until cancelled."""
        while self._recording is not None:
            await asyncio.sleep(1.0)
            await asyncio.to_thread(self._recording.flush)

    async def check_watchdogs(self) -> None:
        """Stop clients that no longer send observations; runs until cancelled."""
        period = max(self.posting.safety.control_dt or 1.0, _MIN_TICK_S)
        while True:
            await asyncio.sleep(period)
            now = time.monotonic()
            for session in list(self._sessions.values()):
                session.check_watchdog(now)

    async def serve_client(self, request: web.Request) -> web.StreamResponse:
        """Serve one WebSocket connection."""
        if len(self._sessions) > self.request.max_clients:  # one of them is `posting`
            self.measurements.refused += 1
            return web.Response(
                status=503, text=f"{self.request.max_clients} clients are connected; --max-clients allows no more\n"
            )
        session = self._open_session()
        self.measurements.connections += 1
        try:
            socket = web.WebSocketResponse(
                compress=False, max_msg_size=self.largest_message, heartbeat=_HEARTBEAT_S, timeout=1.0
            )
            await socket.prepare(request)
            await socket.send_bytes(messages.pack(self.metadata))
            try:
                await self._answer_all(socket, session)
            except ConnectionError:  # the client disconnected, or did not answer a heartbeat in time
                if request.transport is not None:
                    request.transport.abort()
            return socket
        finally:
            self._close_session(session)

    async def _answer_all(self, socket: web.WebSocketResponse, session: Session) -> None:
        before_s: float | None = None
        ready = time.perf_counter()
        async for message in socket:
            begin = time.perf_counter()
            if begin - ready < _NO_WAIT_S:  # the message had already arrived: serve other clients before a flood
                await asyncio.sleep(0)
            try:
                if message.type is not aiohttp.WSMsgType.BINARY:
                    raise messages.MessageError("text frame received; send binary frames of msgpack")
                answer = session.answer(messages.unpack(message.data))
            except messages.MessageError as error:
                self.measurements.errors += 1
                self._write_fault(session, "message", str(error))
                await socket.send_str(str(error))
                ready = time.perf_counter()
                continue
            if before_s is not None:
                answer["server_timing"]["prev_total_ms"] = before_s * 1000.0
            await socket.send_bytes(messages.pack(answer))
            ready = time.perf_counter()
            before_s = ready - begin
            self.measure(session, answer, before_s)

    def measure(self, session: Session, answer: dict[str, Any], seconds: float) -> None:
        """Record the duration [s] and the outcome of an answer."""
        measured = self.measurements
        measured.request.add(seconds)
        if (infer_ms := answer["server_timing"]["infer_ms"]) > 0.0:
            measured.inference.add(infer_ms / 1000.0)
        measured.control_error = session.safety.control_error
        if "error" in answer:
            measured.errors += 1
        if self._recording is not None:
            self._record(self._recording, session, infer_ms)
        if (dt := session.safety.control_dt) is not None and seconds > dt:
            measured.deadline_misses += 1
            self._write_fault(session, "deadline", seconds, dt)

    def _record(self, recording: RerunLog, session: Session, infer_ms: float) -> None:
        root, reader, now = f"client_{session.number}", session.safety.reader, time.time()
        recording.add(f"{root}/action", session.action, now)
        recording.add(f"{root}/infer_ms", infer_ms, now)
        recording.add(f"{root}/episode", float(session.episode), now)
        recording.add(f"{root}/limited", float(session.is_limited), now)
        if session.observation is not None:
            flat = reader.flatten(session.observation)
            for name, part in reader.layout.columns.items():
                recording.add(f"{root}/observation/{name}", flat[part].copy(), now)

    def give_order(self, order: str) -> int:
        """Give an order to all present and later clients; return their number. Raises `UsageError` without a home."""
        for session in self._sessions.values():
            session.order(order)
        self._order = None if order == "resume" else order
        self._log.write("order", name=order)
        return len(self._sessions)

    def override(self, action: Any | None) -> list[float] | None:
        """Override all present and later clients; None ends it. Raises `ValueError` for an invalid action.

        Return the action within the bounds of the policy's actions if it is outside them, or else None.
        """
        for session in self._sessions.values():
            session.safety.override(action)
        self._manual = action
        self._log.write("order", name="policy" if action is None else "override")
        space = self.policy.info.env.spaces()[1]
        if action is None or not isinstance(space, spaces.Box):
            return None
        given = np.asarray(action, np.float64).ravel()
        bounded = np.clip(given, space.low.ravel(), space.high.ravel())
        return None if (bounded == given).all() else bounded.tolist()

    def summarize(self) -> str:
        """Return what it has done so far, as one line."""
        answers = output.format_count(self.measurements.request.count, "answer")
        clients = output.format_count(self.measurements.connections, "connection")
        interventions = output.format_count(self.count_interventions().total(), "intervention")
        duration = output.format_duration(time.monotonic() - self._began_s)
        return f"served {answers} in {duration}: {clients}, {interventions} of limits and faults"

    async def replace_policy(self, file: Path) -> None:
        """Replace the policy from the next steps on; if it does not fit, raise `RlctlError` and keep the old one."""
        try:
            policy = await asyncio.to_thread(load_served_policy, file)
            policy.check_replaces(self.policy.info.env)
        except RlctlError as error:
            problem = str(error).replace(f"{file.parent}/", "")  # a temporary folder
            self._log.write("policy refused", name=file.name, value=short_repr(problem, 200))
            raise
        self.policy = policy
        self.measurements.policy_changes += 1
        self._log.write("policy", **_describe_policy(policy))

    def count_states(self) -> collections.Counter[str]:
        """Return how many clients are in each state."""
        return collections.Counter(session.safety.state for session in self._sessions.values())

    def measure_spread(self) -> None:
        """Measure the spread of the policy's actions, for the newest client's observation."""
        for session in reversed(self._sessions.values()):
            if session.observation is not None and session.safety.trusts_observation:
                self.measurements.spread = self.policy.measure_spread(session.observation)
                return

    def describe(self) -> dict[str, Any]:
        """Return the content of the live page."""
        measured = self.measurements
        self.measure_spread()
        return {
            "policy": self.policy.file.name,
            "task": self.policy.info.spec.task,
            "control_dt": self.posting.safety.control_dt,
            "requests": measured.request.count,
            "request": measured.request.quantiles(),
            "inference": measured.inference.quantiles(),
            "deadline_misses": measured.deadline_misses,
            "errors": measured.errors,
            "spread": measured.spread,
            "counts": dict(self.count_interventions().most_common(20)),
            "clients": [_describe(session) for session in self._sessions.values() if session.safety.steps],
        }


def _describe_policy(policy: ServedPolicy) -> dict[str, Any]:
    return {"name": policy.file.name, "sha256": policy.sha256, "training_steps": policy.info.training_steps}


def _describe(session: Session) -> dict[str, Any]:
    safety = session.safety
    flat = None if session.observation is None else safety.reader.flatten(session.observation)
    return {
        "number": session.number,
        "state": safety.state,
        "reason": safety.reason,
        "overridden": safety.manual is not None,
        "steps": safety.steps,
        "control_error": safety.control_error,
        "action": None if session.action is None else session.action.ravel()[:32],
        "observation": {
            name: [] if flat is None else flat[part][:32]
            for name, part in list(safety.reader.layout.columns.items())[:16]
        },
        "events": [dataclasses.asdict(event) for event in safety.find_last_events(8)],
    }
