"""Processes forked from one that has imported what they import: started as by `subprocess.Popen`, in milliseconds.

Most of the time of a small training is spent on imports, so tests start processes this way unless the start itself is
what they test. A process has the folder, environment, descriptors, cores, process group and signal mask that its caller
gives it, and is the caller's child: exit codes, `getppid` and `psutil` see no difference. It differs from a fresh
interpreter in that everything is imported already, and in that no `atexit` function runs. Linux only.
"""

import contextlib
import ctypes
import functools
import gc
import importlib
import json
import os
import pkgutil
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from rlctl.processes import child_process
from tests.forked_process import SIGNALS, become

ROOT = Path(__file__).parents[1]
FOR_WORKERS = ("rlctl.play.worker", "rlctl.task.env", "rlctl.environments.info", "rlctl.checking.child")
FOR_COMMANDS = (
    *("torch.utils.tensorboard", "stable_baselines3", "sb3_contrib", "rlctl.cli", "rich.console"),
    *("rlctl.evaluation.evaluate", "rlctl.evaluation.report", "rlctl.policy.torch_policy", "rlctl.tasks.listing"),
    *("typer.rich_utils", "typer._adapters", "rich._emoji_codes", "yaml", "onnx"),
)
ROOMS_FOR_COMMANDS = (
    *("rlctl.training", "rlctl.launching", "rlctl.checking", "rlctl.evaluation", "rlctl.runs", "rlctl.storage"),
)
"""What is imported when it is needed; one that is missing here costs time only."""
HASH_SEED = "0"
"""Of all forks: that of check-env's processes but one."""
_PR_SET_CHILD_SUBREAPER = 36
_MADV_COLLAPSE = 25
_HUGE = 2**21  # bytes


class ForkedProcess:
    """A child of this process, with the part of `subprocess.Popen` that is used here."""

    def __init__(self, command, pid):
        self.args = command
        self.pid = pid
        self.returncode = None

    def poll(self):
        return self._wait(0.0)

    def wait(self, timeout=None):
        if self._wait(timeout) is None:
            raise subprocess.TimeoutExpired(self.args, timeout)
        return self.returncode

    def _wait(self, timeout):
        if self.returncode is None and self._has_ended(timeout):
            try:
                self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
            except ChildProcessError:  # somebody else has waited for it
                self.returncode = 0
        return self.returncode

    def _has_ended(self, timeout):
        try:
            descriptor = os.pidfd_open(self.pid)
        except ProcessLookupError:
            return True
        with open(descriptor, "rb"):
            return bool(select.select([descriptor], [], [], timeout)[0])

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        self.send_signal(signal.SIGKILL)

    def terminate(self):
        self.send_signal(signal.SIGTERM)


class ForkServer:
    """A process that forks on request."""

    def __init__(self, connection, process):
        self._connection = connection
        self._process = process
        self._lock = threading.Lock()

    @classmethod
    def launch(cls, start_process=subprocess.Popen, *, commands=False):
        """Start a server for workers, or for whole commands."""
        ours, theirs = socket.socketpair()
        code = f"from tests import fork_server; fork_server.main({theirs.fileno()}, {commands})"
        with theirs:
            process = start_process(
                [sys.executable, "-c", code],
                cwd=ROOT,
                pass_fds=(theirs.fileno(),),
                env={**os.environ, "PYTHONHASHSEED": HASH_SEED},
                process_group=0,  # an interrupt at the terminal is for the tests
            )
        return cls(ours, process)

    @classmethod
    def fork(cls):
        """Make a fork of this process the server: before it has threads."""
        ours, theirs = socket.socketpair()
        pid = os.fork()
        if pid == 0:
            ours.close()
            with open(os.devnull, "r+b") as nothing:
                for descriptor in (0, 1, 2):  # or a reader of this process's output would wait for the server's end
                    os.dup2(nothing.fileno(), descriptor)
            serve(theirs)
        theirs.close()
        return cls(ours, ForkedProcess([], pid))

    def start(
        self,
        command,
        *,
        pass_fds=(),
        stdin=None,
        stdout=None,
        stderr=None,
        env=None,
        cwd=None,
        process_group=None,
        start_new_session=False,
    ):
        """Start `[python, "-c", code, ...]` or `[python, "-m", module, ...]` with options of `subprocess.Popen`.

        One that is to have another hash seed than the server is a fresh interpreter.
        """
        if env is not None and env.get("PYTHONHASHSEED", HASH_SEED) != HASH_SEED:
            options = {"env": env, "cwd": cwd, "process_group": process_group, "start_new_session": start_new_session}
            return subprocess.Popen(command, pass_fds=pass_fds, stdin=stdin, stdout=stdout, stderr=stderr, **options)
        with contextlib.ExitStack() as opened:
            standard = [
                opened.enter_context(open(os.devnull, "r+b")).fileno() if each == subprocess.DEVNULL else each
                for each in (stdin, stdout, stderr)
            ]
            descriptors = [number if each is None else each for number, each in enumerate(standard)]
            request = {
                "command": command,
                "descriptors": [0, 1, 2, *pass_fds],
                "env": dict(os.environ if env is None else env),
                "cwd": os.path.abspath(cwd or "."),
                "process_group": process_group,
                "session": start_new_session,
                "cores": sorted(os.sched_getaffinity(0)),
                "blocked": [int(number) for number in signal.pthread_sigmask(signal.SIG_BLOCK, ())],
            }
            with self._lock, _adopting():
                _send(self._connection, request, [*descriptors, *pass_fds])
                (pid,) = struct.unpack("i", self._connection.recv(4, socket.MSG_WAITALL))
        return ForkedProcess(command, pid)

    def run(self, command, *, timeout=None, stdout=None, **options):
        """Run a command to its end; return what `subprocess.run` returns, with the output as text."""
        with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
            output = {"stdout": out.fileno() if stdout is None else stdout, "stderr": err.fileno()}
            process = self.start(command, **output, **options)
            try:
                process.wait(timeout)
            finally:
                process.kill()
                process.wait()
            texts = [(file.seek(0), file.read().decode(errors="replace"))[1] for file in (out, err)]
        return subprocess.CompletedProcess(command, process.returncode, *texts)

    def close(self):
        self._connection.close()
        self._process.wait()


@functools.cache
def for_workers():
    """Return the server of this process that has imported what a worker imports."""
    return ForkServer.launch()


@functools.cache
def for_commands():
    """Return the server of this process that has also imported torch and the command line."""
    return ForkServer.launch(for_workers().start, commands=True)


def close():
    """End the servers of this process."""
    for server in (for_commands, for_workers):
        if server.cache_info().currsize:
            server().close()
            server.cache_clear()


def start(command, **options):
    """Start a child process as `subprocess.Popen` does, by a server of this process."""
    is_command = "-m" in command[1:3] and "rlctl" in command[2:4]
    server = for_commands if is_command or _is_training(command) else for_workers
    return server().start(command, **options)


def _is_training(command):
    """Return whether a command is a `ChildProcess` that trains, and starts workers of its own."""
    return '"main": "rlctl.launching.child:main"' in command[-1]


@contextlib.contextmanager
def _adopting():
    """Make this process the parent of what the server starts: the next one above a process whose parent has ended."""
    prctl = ctypes.CDLL(None).prctl
    prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    try:
        yield
    finally:
        prctl(_PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0)


def _send(connection, request, descriptors):
    content = json.dumps(request).encode()
    socket.send_fds(connection, [struct.pack("i", len(content))], descriptors)
    connection.sendall(content)


def _receive(connection):
    head, descriptors, _, _ = socket.recv_fds(connection, 4, 64)
    if not head:
        return None
    request = json.loads(connection.recv(struct.unpack("i", head)[0], socket.MSG_WAITALL))
    return request, descriptors


def serve(connection, commands=False):
    """Fork for every request until the other end is closed; a command gets a server for its workers."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    while received := _receive(connection):
        read_end, write_end = os.pipe()
        between = os.fork()
        if between == 0:
            # It ends at once, so that the new process gets the caller as its parent.
            received[0]["between"] = os.getpid()
            if os.fork() == 0:
                starts_workers = commands or _is_training(received[0]["command"])
                become(*received, write_end, _start_own_server if starts_workers else lambda: None)
            os._exit(0)
        os.close(write_end)
        for descriptor in received[1]:
            os.close(descriptor)
        with open(read_end, "rb") as pipe:
            pid = pipe.read(4)
        os.waitpid(between, 0)
        connection.sendall(pid)
    os._exit(0)


def _start_own_server():
    child_process.start_process = ForkServer.fork().start


def _use_huge_pages():
    """Let this process's memory be a few huge pages: a fork of 40,000 small ones takes three times as long."""
    madvise = ctypes.CDLL(None).madvise
    madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    for line in Path("/proc/self/maps").read_text().splitlines():
        addresses, access, _, _, _, *name = line.split()
        if "w" in access and name in ([], ["[heap]"]):
            first, last = (int(each, 16) for each in addresses.split("-"))
            first = -(-first // _HUGE) * _HUGE
            madvise(first, max(0, last // _HUGE * _HUGE - first), _MADV_COLLAPSE)  # without effect before Linux 6.1


def main(descriptor, commands):
    """Import what the processes need, and serve."""
    gc.disable()  # what is imported stays
    for name in FOR_WORKERS + (FOR_COMMANDS if commands else ()):
        importlib.import_module(name)
    if commands:
        for name in ROOMS_FOR_COMMANDS:
            room = importlib.import_module(name)
            for module in pkgutil.iter_modules(room.__path__, f"{name}."):
                importlib.import_module(module.name)
    gc.collect()
    gc.freeze()
    gc.enable()
    _use_huge_pages()
    serve(socket.socket(fileno=descriptor), commands)
