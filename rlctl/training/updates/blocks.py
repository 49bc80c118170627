"""Row blocks of minibatches, computed on all cores.

A minibatch is split into row blocks, how many depends on the algorithm and not on the machine, and the gradients of the
blocks are added in order: a training has the same bits with any number of cores. Blocks are computed by processes
without torch, which share all arrays: threads would wait for Python's lock, since most calls take microseconds.
"""

import abc
import contextlib
import importlib
import os
import socket
import weakref
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rlctl.play.shared_arrays import ArrayLayout, map_arrays
from rlctl.play.workers import available_cores
from rlctl.printed_lines import print_line
from rlctl.processes.child_process import ChildProcess, anonymous_file
from rlctl.training.updates.perceptrons import ArrayShapes, Floats, count_floats

MAX_BLOCKS = 8
OFF_POLICY_BLOCKS = 4  # their minibatches are small, and all blocks' gradients of their large critics are added
_MIN_ROWS = 32  # of a block: below, NumPy's calls take longer than their arithmetic
_MIN_MULTIPLICATIONS = 1_000_000  # of a block in a forward pass of all networks: below, waking a process takes longer
_MAX_TASKS = 16  # of one phase
_ADD = 15  # the phase that adds the blocks' gradients
_MIN_FLOATS = 100_000  # of all blocks' gradients, from which several processes add them
_CHECK_EVERY_S = 1.0

Arrays = dict[str, NDArray[Any]]


def count_blocks(rows: int, weights: int, most: int = MAX_BLOCKS) -> int:
    """Return into how many blocks to split a minibatch for networks with so many weights."""
    return max(1, min(most, rows // _MIN_ROWS, rows * weights // _MIN_MULTIPLICATIONS))


def select_block(block: int, count: int, first: int, size: int) -> slice:
    """Return the rows of a block of a minibatch, which has `size` rows from row `first` on."""
    return slice(first + size * block // count, first + size * (block + 1) // count)


class BlockSettings(Protocol):
    """Plain data that describes the networks and the arrays of an update."""

    def list_shapes(self) -> ArrayShapes:
        """Return the shapes of all trained parameters."""

    def make_layout(self) -> ArrayLayout:
        """Return the arrays that all processes share besides the parameters and their gradients."""


class BlockWork(abc.ABC):
    """What is computed for each row block; `arrays` are shared by all processes."""

    @abc.abstractmethod
    def __init__(self, arrays: Arrays, settings: Any) -> None: ...

    @abc.abstractmethod
    def compute(self, phase: int, task: int) -> None:
        """Read the shared arrays, and write parts of them that no other task of this phase reads or writes."""


class Blocks:
    """Computes tasks in this process and, for phases of up to `tasks` of them, in processes on the other cores.

    `cores` is how many processes there are, by default one per core. `arrays` has `parameters`, `gradient` and the
    `gradients` of each block, shape (blocks, floats), besides those of the settings.
    """

    def __init__(self, kind: type[BlockWork], settings: BlockSettings, tasks: int, *, cores: int | None = None) -> None:
        length = count_floats(settings.list_shapes())
        layout = {**settings.make_layout(), **_make_layout(length)}
        memory = anonymous_file()
        self.arrays: Arrays = map_arrays(memory, layout)
        self.work = kind(self.arrays, settings)
        self._processes: list[ChildProcess] = []
        # Every process takes the next task from one socket, and reports it in the other.
        ends = self._tasks, self._taken, self._reports, reported = *socket.socketpair(), *socket.socketpair()
        self._reports.settimeout(_CHECK_EVERY_S)
        descriptors = {"memory": memory, "taken": self._taken.fileno(), "reported": reported.fileno()}
        arguments = {"kind": f"{kind.__module__}:{kind.__name__}", "settings": settings, "layout": layout}
        try:
            for _ in range(min(cores or available_cores(), tasks) - 1):
                process = ChildProcess(f"{__name__}:main", {**arguments, **descriptors}, pass_fds=descriptors.values())
                self._processes.append(process)
        except OSError as error:
            print_line(f"updates use fewer cores: a process cannot be started: {error.strerror or error}")
        os.close(memory)
        self.close = weakref.finalize(self, _close, self._processes, ends)
        """Ends the processes; this process computes all tasks from then on. A second call does nothing."""

    def run(self, phase: int, count: int) -> None:
        """Compute tasks 0 to `count` - 1 of a phase."""
        if count > 1 and self._processes and self._share(phase, count):
            return
        for task in range(count):
            _compute(self.work, self.arrays, phase, task)

    def add_gradients(self, count: int, part: slice) -> Floats:
        """Add this part of the first `count` blocks' gradients in order; return the part of `gradient`."""
        self.arrays["added"][:] = count, part.start, part.stop
        self.run(_ADD, _MAX_TASKS if count * (part.stop - part.start) >= _MIN_FLOATS else 1)
        return self.arrays["gradient"][part]

    def _share(self, phase: int, count: int) -> bool:
        """Compute tasks in all processes; return False if one has ended."""
        self._tasks.send(bytes(phase * _MAX_TASKS + task for task in range(count)))
        done = 0
        while token := _take(self._taken):
            _compute(self.work, self.arrays, *divmod(token[0], _MAX_TASKS))
            done += 1
        while done < count:
            try:
                done += len(self._reports.recv(count))
            except TimeoutError:
                ended = [process for process in self._processes if process.process.poll() is not None]
                if ended:
                    print_line(f"updates continue on one core: a process {ended[0].describe_end()}")
                    self.close()
                    return False
        return True


def _make_layout(length: int) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
    floats = np.dtype(np.float32)
    return {
        "parameters": ((length,), floats),
        "gradient": ((length,), floats),
        "gradients": ((MAX_BLOCKS, length), floats),
        "added": ((3,), np.dtype(np.int64)),  # number of blocks, first and last float
    }


def _compute(work: BlockWork, arrays: Arrays, phase: int, task: int) -> None:
    if phase != _ADD:
        work.compute(phase, task)
        return
    # The number of parts does not matter for the bits, only the order of the blocks.
    count, first, last = arrays["added"].tolist()
    parts = _MAX_TASKS if count * (last - first) >= _MIN_FLOATS else 1
    part = select_block(task, parts, first, last - first)
    np.add.reduce(arrays["gradients"][:count, part], axis=0, out=arrays["gradient"][part])


def _take(taken: socket.socket) -> bytes:
    with contextlib.suppress(BlockingIOError):
        return taken.recv(1, socket.MSG_DONTWAIT)
    return b""


def _close(processes: list[ChildProcess], ends: Sequence[socket.socket]) -> None:
    for process in processes:
        process.close()
    processes.clear()
    for end in ends:
        end.close()


def main(
    connection: Connection, *, kind: str, settings: Any, layout: ArrayLayout, memory: int, taken: int, reported: int
) -> None:
    """In a child: compute tasks until the parent ends."""
    module, _, name = kind.partition(":")
    arrays = map_arrays(memory, layout)
    work = getattr(importlib.import_module(module), name)(arrays, settings)
    np.seterr(all="ignore")  # the parent warns, once
    with socket.socket(fileno=taken) as tasks, socket.socket(fileno=reported) as reports, connection:
        while token := tasks.recv(1):
            _compute(work, arrays, *divmod(token[0], _MAX_TASKS))
            reports.send(token)
