"""Clients that flood the server, send gigabytes or half a frame, or die do not disturb the other clients."""

import contextlib
import gzip
import os
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.request

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from rlctl.play import remote_messages as messages
from rlctl.play.remote import PolicyClient
from rlctl_robot.serve import routes
from rlctl_robot.serve.records import read_memory
from tests.limits.conftest import REPEATABLE
from tests.robot.serve.serving import OBSERVATION, RunningServer, write_policy


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    file = write_policy(tmp_path_factory.mktemp("served") / "policy.safetensors")
    running = RunningServer(file, watchdog=False, max_clients=8)
    yield running
    running.close()


def open_socket(server):
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=120)
    connection.sendall(
        b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    )
    return connection, connection.recv(65536)


def frame(content, length=None):
    """A masked binary frame."""
    length = len(content) if length is None else length
    return b"\x82" + bytes([0x80 | 127]) + struct.pack(">Q", length) + b"\0\0\0\0" + content


def read_all(connection):
    received = b""
    while chunk := connection.recv(65536):
        received += chunk
    return received


def works(server):
    with server.client() as client:
        return client.ask(OBSERVATION)["actions"].tolist() == [[6.0, 1.0]]


def test_a_gigabyte(server):
    before = read_memory()
    connection, _ = open_socket(server)
    connection.sendall(frame(b"x" * 1000, length=2**30))
    assert b"\x03\xf1" in read_all(connection)  # close code 1009: too big
    assert read_memory() - before < 50e6
    assert works(server)


def test_half_a_frame_and_death(server):
    for content in (frame(b"x" * 100, length=200), b"\x82", frame(b"")[:5]):
        connection, _ = open_socket(server)
        connection.sendall(content)
        assert works(server)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.close()  # resets the connection
    assert works(server)


def test_a_flood_that_reads_nothing(server):
    content = frame(messages.pack(OBSERVATION)) * 200
    flooding = [open_socket(server)[0] for _ in range(3)]
    done = threading.Event()

    def flood(connection):
        connection.settimeout(0.2)
        try:
            while not done.is_set():
                connection.sendall(content)
        except OSError:  # the server reads no more
            done.wait(30)

    threads = [threading.Thread(target=flood, args=(connection,)) for connection in flooding]
    for thread in threads:
        thread.start()
    before = read_memory()
    assert works(server)
    done.set()
    for thread in threads:
        thread.join()
    for connection in flooding:
        connection.close()
    assert read_memory() - before < 50e6


def test_two_hundred_connections(server):
    with server.client() as client:
        opened = [open_socket(server) for _ in range(100)]
        idle = [socket.create_connection(("127.0.0.1", server.port), timeout=120) for _ in range(100)]
        for connection in idle:
            connection.sendall(b"POST /act HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n\r\n{")
        assert client.ask(OBSERVATION)["actions"].tolist() == [[6.0, 1.0]]
        answers = [first.split(b"\r\n")[0] for _, first in opened]
        assert answers.count(b"HTTP/1.1 101 Switching Protocols") <= 7
        assert answers.count(b"HTTP/1.1 503 Service Unavailable") >= 93
        for connection in [*idle, *(connection for connection, _ in opened)]:
            connection.close()


def test_request_heads_that_never_end_are_timed_out(server, monkeypatch):
    monkeypatch.setattr(routes, "_FIRST_REQUEST_S", 0.1)
    with server.client() as client:
        slow = socket.create_connection(("127.0.0.1", server.port), timeout=30)
        slow.sendall(b"GET /metadata HTTP/1.1\r\nHost: localhost\r\nX-Slow: ")
        with contextlib.suppress(ConnectionResetError):
            assert slow.recv(1000) == b""  # closed
        assert client.ask(OBSERVATION)["actions"].tolist() == [[6.0, 1.0]]  # robots stay


@pytest.mark.slow
def test_a_stop_is_served_with_few_file_descriptors_and_many_connections(tmp_path):
    file = write_policy(tmp_path / "policy.safetensors")
    command = f"ulimit -n 256; exec {sys.executable} -m rlctl serve {file} --port 0 --max-clients 8"
    process = subprocess.Popen(["bash", "-c", command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        port = int(process.stdout.readline().partition("ws://127.0.0.1:")[2].partition(",")[0])
        robot = PolicyClient(f"ws://127.0.0.1:{port}")
        opened = []
        half_head = b"GET / HTTP/1.1\r\nX-Slow: "
        half_body = b"POST /act HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n"
        for sent in [half_head] * 400 + [half_body] * 400:
            opened.append(socket.create_connection(("127.0.0.1", port), timeout=30))
            with contextlib.suppress(ConnectionResetError):
                opened[-1].sendall(sent)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/stop", b"", timeout=5) as answer:
            assert answer.status == 200
        assert robot.ask(OBSERVATION)["state"] == "stopped"
        robot.close()
        for connection in opened:
            connection.close()
        process.terminate()
        errors = process.communicate(timeout=30)[1].splitlines()
        assert len(errors) == 1
        assert errors[0].startswith("warning: no --limits FILE")
    finally:
        process.kill()


@pytest.mark.slow
def test_too_few_file_descriptors(tmp_path):
    file = write_policy(tmp_path / "policy.safetensors")
    command = f"ulimit -n 128; exec {sys.executable} -m rlctl serve {file} --port 0"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert done.returncode == 2
    assert (
        "--max-clients 64: this process may open 128 files, which is too few; raise the limit, ulimit -n" in done.stderr
    )


@pytest.mark.parametrize("headers", [{"Host": "[::1"}, {"Origin": "http://["}, {"Host": "[]"}, {"Origin": "[x]://"}])
def test_addresses_that_are_none(server, headers, capfd):
    assert server.get("/metadata", headers=headers)[0] in (400, 403)
    assert capfd.readouterr().err == ""


@pytest.mark.slow
def test_a_compressed_body_is_refused_before_it_is_unpacked(server):
    body = gzip.compress(bytes(200_000_000))
    began = time.process_time()
    assert server.post("/act", body, headers={"Content-Encoding": "gzip"})[0] == 415
    assert time.process_time() - began < 0.1


def test_numbers_of_401_digits(server, capfd):
    number = "1" * 401
    assert server.post("/override", f'{{"action": [{number}, 0]}}'.encode())[0] == 400
    assert server.post("/override", b'{"action": ["a", {}]}')[0] == 400
    assert server.post("/act", f'{{"observation": [{number}, 0, 0, 0, 0]}}'.encode())[0] == 400
    assert server.post("/act", f'{{"observation": [0, 0, 0, 0, 0], "age_s": {number}}}'.encode())[0] == 400
    assert server.post("/act", f'{{"observation": [0, 0, 0, 0, 0], "reset": {number}}}'.encode())[0] == 200
    assert capfd.readouterr().err == ""


@settings(REPEATABLE, max_examples=100)
@given(st.one_of(st.binary(max_size=200), st.integers(0, 255).map(lambda byte: bytes([byte]) * 50)))
def test_any_bytes_are_a_message_or_not(content):
    for read in (messages.unpack, messages.parse_json):
        try:
            read(content)
        except messages.MessageError:
            continue


def test_arrays_come_back(tmp_path):
    import numpy as np

    for value in (np.arange(6, dtype=np.int16).reshape(2, 3), np.zeros((0, 3)), np.array(True), np.float32(1.5)):
        back = messages.unpack(messages.pack({"a": value}))["a"]
        assert back.dtype == value.dtype
        np.testing.assert_array_equal(back, value)
    with pytest.raises(TypeError, match="cannot be sent"):
        messages.pack(np.array([1j]))
    assert messages.unpack(messages.pack({"a": os.name})) == {"a": os.name}


@pytest.mark.parametrize("request_line", [b"\x00\x01", b"GET / HTTP/9.9", b"GET /\x1b[31m HTTP/1.1"])
def test_what_is_no_http_leaves_no_traceback(server, request_line, caplog):
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=120)
    connection.sendall(request_line + b"\r\nHost: localhost\r\n\r\n")
    assert read_all(connection).startswith(b"HTTP/1.0 400 ")
    assert not caplog.records
    assert works(server)
