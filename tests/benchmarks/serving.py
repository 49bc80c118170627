"""How quickly a policy server answers, with reach's policy: clients in processes of their own, over loopback."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator

import aiohttp
import numpy as np

from rlctl.environments.info import EnvInfo
from rlctl.limits.limits import Limits
from rlctl.limits.safety_filter import SafetyFilter
from rlctl.play import remote_messages as messages
from rlctl.policy.shipped import find_shipped_policy
from tests.benchmarks.row import Row

_SIZE = 20  # of reach's observation
_CLIENT = "from tests.benchmarks.serving import run_clients; run_clients({port}, {clients}, {rate}, {count})"


def one_client(repeat: int) -> Row:
    """500 Hz for a minute."""
    p50, p99, late, _ = _measure(clients=1, rate=500.0, count=30_000)
    reached = p50 <= 0.4 and p99 <= 2.0
    note = f"30,000 round trips at 500 Hz; {late} later than control_dt"
    return Row("serve: one client", f"p50 {p50:.2f} ms", "0.4 ms", f"p99 {p99:.2f} ms", "<= 2 ms", reached, note)


def sixteen_clients(repeat: int) -> Row:
    """16 clients at 60 Hz for a minute."""
    p50, p99, late, _ = _measure(clients=16, rate=60.0, count=3600)
    note = f"16 clients, 3,600 round trips each at 60 Hz; p50 {p50:.2f} ms, p99 {p99:.2f} ms; deadline: control_dt"
    return Row("serve: 16 clients", f"{late} late", "57,600 answers", "-", "0 late", late == 0, note)


def memory(repeat: int) -> Row:
    """Memory over a million requests, which take five minutes."""
    *_, growth = _measure(clients=1, rate=1e9, count=1_000_000)
    note = "resident memory of the server after the first 1,000 and after 1,000,000 requests"
    return Row("serve: memory", f"{growth / 1e6:+.1f} MB", "-", "-", "<= 5 MB", growth <= 5e6, note)


def against_plain_server(repeat: int) -> Row:
    """Against a server that is built as openpi's and does nothing but act: by turns, both running."""
    with _server() as ours, _server("tests.benchmarks.plain_server", str(find_shipped_policy("reach"))) as theirs:
        command = f"from tests.benchmarks.serving import take_turns; take_turns([{ours}, {theirs}], {40 * repeat})"
        done = subprocess.run([sys.executable, "-c", command], check=True, capture_output=True, text=True)
    times = np.array(json.loads(done.stdout))
    ratio = float(np.median(times[:, 0] / times[:, 1]))
    p50s = [f"p50 {each:.3f} ms" for each in np.median(times, axis=0)]
    note = f"{len(times)} turns of 200 round trips, median ratio; the plain server checks, bounds and counts nothing"
    return Row("serve: against openpi's kind", *p50s, f"{1 / ratio:.2f}x", "1x", ratio <= 1.0, note)


def take_turns(ports: list[int], turns: int) -> None:
    """Act 200 times with each server by turns; print the medians of the round trips [ms], a pair per turn."""

    async def act() -> list[list[float]]:
        async with aiohttp.ClientSession() as session:
            sockets = [await session.ws_connect(f"ws://127.0.0.1:{port}", compress=0) for port in ports]
            for socket in sockets:
                await socket.receive()  # the metadata
            medians = []
            for turn in range(turns):
                pair = [0.0, 0.0]
                for index in (0, 1) if turn % 2 else (1, 0):
                    pair[index] = float(np.median(await _act_alone(sockets[index], 0.0, 1e9, 200))) * 1e3
                medians.append(pair)
            return medians

    print(json.dumps(asyncio.run(act())))


def start(repeat: int) -> Row:
    """From the command to the first answer."""
    times = []
    for _ in range(repeat):
        before = time.monotonic()
        with _server():
            times.append(time.monotonic() - before)
    seconds = float(np.median(times))
    note = "from the command to the line that it serves, of an installed rlctl"
    return Row("serve: start", f"{seconds:.2f} s", "-", "-", "<= 1.5 s", seconds <= 1.5, note)


def safety_filter(repeat: int) -> Row:
    """A call of the filter with all limits: where none has to act, and where one does on every joint."""
    quiet = _time_filter([np.full(7, 0.001)], repeat)
    acting = _time_filter([np.full(7, 5.0), np.full(7, -5.0)], repeat)
    note = f"observe and limit, 7 joints, limits of position, speed and acceleration; all 7 limited: {acting:.1f} us"
    # Half of it are some 25 NumPy calls of 0.3 us: the check of the observation, the command, and a last check that
    # uses none of its results.
    return Row("safety filter", f"{quiet:.1f} us", "-", "-", "<= 20 us", max(quiet, acting) <= 20.0, note)


def _time_filter(actions: list[np.ndarray], repeat: int) -> float:
    """Return the least time of a step [us] for actions by turns."""
    info = EnvInfo.model_validate(
        {
            "observation_space": {"type": "Box", "low": "-inf", "high": "inf", "shape": [_SIZE], "dtype": "float32"},
            "action_space": {"type": "Box", "low": "-1.0", "high": "1.0", "shape": [7], "dtype": "float32"},
            "observation_sizes": {"positions": 7, "rest": _SIZE - 7},
            "control_dt": 1 / 60,
        }
    )
    limits = {"all": {"position": [-2, 2], "speed": 1.5, "acceleration": 10}}
    settings = {"command": "position", "scale": 1.0, "measured": {"position": "positions"}, "limits": limits}
    safety = SafetyFilter(info, Limits.model_validate(settings))
    observation, times = np.zeros(_SIZE, np.float32), []
    for _ in range(5 * repeat):
        before = time.process_time()
        for step in range(1000):
            safety.observe(observation)
            safety.limit(actions[step % len(actions)])
        times.append((time.process_time() - before) * 1e3)
    return min(times)


@contextlib.contextmanager
def _server(module: str = "rlctl", *arguments: str) -> Iterator[int]:
    command = [sys.executable, "-m", module, *(arguments or ("serve", "reach", "--pretrained", "--port", "0"))]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout is not None
        yield int(re.findall(r"ws://127.0.0.1:(\d+)", process.stdout.readline())[0])
    finally:
        process.terminate()
        process.wait()


def _measure(clients: int, rate: float, count: int) -> tuple[float, float, int, float]:
    """Return p50 and p99 of round trips [ms], how many were later than control_dt, and how the memory grew."""
    with _server() as port:
        _run_clients(port, clients=1, rate=1e9, count=1000)
        before = _read_memory(port)
        p50, p99, late = _run_clients(port, clients, rate, count)
        return float(p50), float(p99), int(late), _read_memory(port) - before


def _run_clients(port: int, clients: int, rate: float, count: int) -> list[str]:
    command = _CLIENT.format(port=port, clients=clients, rate=rate, count=count)
    return subprocess.run([sys.executable, "-c", command], check=True, capture_output=True, text=True).stdout.split()


def _read_memory(port: int) -> float:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
        return float(re.findall(r"^rlctl_process_resident_memory_bytes (\S+)", answer.read().decode(), re.MULTILINE)[0])


def run_clients(port: int, clients: int, rate: float, count: int) -> None:
    """Act `count` times with each client, `rate` times a second; print p50, p99 [ms] and how many were late."""
    times = asyncio.run(_act(port, clients, rate, count))
    print(*np.quantile(times, (0.5, 0.99)) * 1e3, int((times > 4 / 240).sum()))


async def _act(port: int, clients: int, rate: float, count: int) -> np.ndarray:
    async with aiohttp.ClientSession() as session:
        sockets = [await session.ws_connect(f"ws://127.0.0.1:{port}", compress=0) for _ in range(clients)]
        for socket in sockets:
            await socket.receive()  # the metadata
        start = time.perf_counter() + 0.1
        each = [_act_alone(socket, start + index / rate / clients, rate, count) for index, socket in enumerate(sockets)]
        return np.concatenate(await asyncio.gather(*each))


async def _act_alone(socket: aiohttp.ClientWebSocketResponse, start: float, rate: float, count: int) -> np.ndarray:
    content = messages.pack({"observation": np.zeros(_SIZE, np.float32)})
    times = np.zeros(count)
    for number in range(count):
        if (wait := start + number / rate - time.perf_counter()) > 0:
            await asyncio.sleep(wait)
        before = time.perf_counter()
        await socket.send_bytes(content)
        await socket.receive()
        times[number] = time.perf_counter() - before
    return times
