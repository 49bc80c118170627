"""Programs that control a robot, in threads of this process: by UDP and by WebSocket."""

import contextlib
import socket
import threading

import numpy as np

from rlctl.errors import PolicyError
from rlctl.play.remote import PolicyClient
from rlctl_robot.robot import packets
from rlctl_robot.robot.packets import Kind, Packet


def control_by_udp(port, act, key=b"", repeats=1, reads="values"):
    """Answer until the test is over; `act(values)`, or of packets, returns a command, a kind, or None for no answer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.connect(("127.0.0.1", port))
        robot.settimeout(20)
        robot.send(packets.pack(Packet(Kind.HELLO, key=key)))
        while (packet := packets.unpack(robot.recv(65536))).kind is not Kind.END:
            answer = act(packet if reads == "packets" else packet.values)
            for _ in range(0 if answer is None else repeats):
                command = packet._replace(kind=Kind.COMMAND, values=answer)
                if isinstance(answer, Kind):
                    command = packet._replace(kind=answer, values=np.zeros(0, np.float32))
                robot.send(packets.pack(command))


class Answers(PolicyClient):
    """The policy server's client, the other way round: it receives first."""

    def control(self, act):
        """Answer observations until the robot closes the connection; `act(request)` returns the whole answer."""
        with contextlib.suppress(PolicyError):  # the robot closes it
            request = self._unpack(self._run(self._socket.receive(20)))
            while True:
                request = self.ask(act(request))


def control_by_websocket(port, act):
    with contextlib.closing(Answers(f"ws://127.0.0.1:{port}")) as client:
        client.control(act)


class Started:
    """What `run_robot` calls when it listens: starts a program in a thread."""

    def __init__(self, program, *arguments, **options):
        self._program, self._arguments, self._options = program, arguments, options
        self.addresses = []

    def __call__(self, addresses):
        self.addresses = addresses
        port = int(addresses[0].rpartition(":")[2])
        self._thread = threading.Thread(target=self._program, args=(port, *self._arguments), kwargs=self._options)
        self._thread.start()

    def join(self):
        self._thread.join(20)
        assert not self._thread.is_alive()
