"""How quickly a policy server answers, with reach's policy: clients in processes of their own, over loopback."""

from __future__ import annotations

import asyncio
import contextlib
import re
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator

import numpy as np

from rlctl.deploy import messages
from rlctl.deploy.limits import Limits
from rlctl.deploy.safety_filter import SafetyFilter
from rlctl.run.env_info import EnvInfo
from tests.benchmarks.row import Row

_SIZE = 20  # of reach's observation
_CLIENT = "from tests.benchmarks.serving import run_clients; run_clients({port}, {clients}, {rate}, {count})"


def one_client(repeat: int) -> Row:
    """500 Hz for ten seconds."""
    p50, p99, late, _ = _measure(clients=1, rate=500.0, count=5000)
    reached = p50 <= 0.4 and p99 <= 2.0
    note = f"5,000 round trips at 500 Hz; {late} later than control_dt"
    return Row("serve: one client", f"p50 {p50:.2f} ms", "0.4 ms", f"p99 {p99:.2f} ms", "<= 2 ms", reached, note)


def sixteen_clients(repeat: int) -> Row:
    """16 clients at 60 Hz for ten seconds."""
    p50, p99, late, _ = _measure(clients=16, rate=60.0, count=600)
    note = f"16 clients, 600 round trips each at 60 Hz; p50 {p50:.2f} ms, p99 {p99:.2f} ms; deadline: control_dt"
    return Row("serve: 16 clients", f"{late} late", "9,600 answers", "-", "0 late", late == 0, note)


def memory(repeat: int) -> Row:
    """Memory over 100,000 requests."""
    *_, growth = _measure(clients=1, rate=1e9, count=100_000)
    note = "resident memory of the server after the first 1,000 and after 100,000 requests"
    return Row("serve: memory", f"{growth / 1e6:+.1f} MB", "-", "-", "<= 5 MB", growth <= 5e6, note)


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
    """A call of the filter with all limits, none of which has to act."""
    info = EnvInfo.model_validate(
        {
            "observation_space": {"type": "Box", "low": "-inf", "high": "inf", "shape": [_SIZE], "dtype": "float32"},
            "action_space": {"type": "Box", "low": "-1.0", "high": "1.0", "shape": [7], "dtype": "float32"},
            "observation_sizes": {"positions": 7, "rest": _SIZE - 7},
            "control_dt": 1 / 60,
        }
    )
    limits = {"all": {"position": [-2, 2], "speed": 1.5, "acceleration": 10}}
    settings = {"command": "position", "measured": {"position": "positions"}, "limits": limits}
    safety = SafetyFilter(info, Limits.model_validate(settings))
    observation, action, times = np.zeros(_SIZE, np.float32), np.full(7, 0.001), []
    for _ in range(5 * repeat):
        before = time.process_time()
        for _ in range(1000):
            safety.observe(observation)
            safety.limit(action)
        times.append((time.process_time() - before) * 1e3)
    best = min(times)
    note = "observe and limit, 7 joints, limits of position, speed and acceleration"
    return Row("safety filter", f"{best:.1f} us", "-", "-", "<= 20 us", best <= 20.0, note)


@contextlib.contextmanager
def _server() -> Iterator[int]:
    command = [sys.executable, "-m", "rlctl", "serve", "reach", "--pretrained", "--port", "0"]
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
        command = _CLIENT.format(port=port, clients=1, rate=1e9, count=1000)
        subprocess.run([sys.executable, "-c", command], check=True, capture_output=True)
        before = _read_memory(port)
        command = _CLIENT.format(port=port, clients=clients, rate=rate, count=count)
        done = subprocess.run([sys.executable, "-c", command], check=True, capture_output=True, text=True)
        p50, p99, late = done.stdout.split()
        return float(p50), float(p99), int(late), _read_memory(port) - before


def _read_memory(port: int) -> float:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
        return float(re.findall(r"^rlctl_process_resident_memory_bytes (\S+)", answer.read().decode(), re.MULTILINE)[0])


def run_clients(port: int, clients: int, rate: float, count: int) -> None:
    """Act `count` times with each client, `rate` times a second; print p50, p99 [ms] and how many were late."""
    times = asyncio.run(_act(port, clients, rate, count))
    print(*np.quantile(times, (0.5, 0.99)) * 1e3, int((times > 4 / 240).sum()))


async def _act(port: int, clients: int, rate: float, count: int) -> np.ndarray:
    import aiohttp

    async with aiohttp.ClientSession() as session:
        sockets = [await session.ws_connect(f"ws://127.0.0.1:{port}", compress=0) for _ in range(clients)]
        start = time.perf_counter() + 0.1
        each = [_act_alone(socket, start + index / rate / clients, rate, count) for index, socket in enumerate(sockets)]
        return np.concatenate(await asyncio.gather(*each))


async def _act_alone(socket: object, start: float, rate: float, count: int) -> np.ndarray:
    await socket.receive()  # the metadata
    content = messages.pack({"observation": np.zeros(_SIZE, np.float32), "reset": True})
    times = np.zeros(count)
    for number in range(count):
        if (wait := start + number / rate - time.perf_counter()) > 0:
            await asyncio.sleep(wait)
        before = time.perf_counter()
        await socket.send_bytes(content)
        await socket.receive()
        times[number] = time.perf_counter() - before
    return times
