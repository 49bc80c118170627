"""Exported controllers that act in this process: compiled C through ctypes, ONNX with onnxruntime."""

import abc
import ctypes
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.exporting.c_source import CSource, compile_code
from rlctl.exporting.controller.graph import LAST_ACTION, TARGET, name_input
from rlctl.exporting.controller.plan import ControllerPlan
from rlctl.exporting.controller.program_mapping import ProgramMapping
from rlctl.policy.actor import Actor, Array, Rows, act_one_by_one
from rlctl.policy.c_policy import action_type
from rlctl.policy.onnx_policy import ACTION, open_session

Inputs = Mapping[str, NDArray[Any]]
STATUS = ("idle", "running", "holding", "stopped")
REASONS = (
    *("", "missing", "not finite", "out of range", "too old", "frozen"),
    *("invalid action", "no action", "no position", "unsafe", "ordered"),
)
ORDERS = ("reset", "stop", "hold", "home", "resume")


class Controller(Actor):
    """A controller in one environment: quantities in, an action and the joints' targets out."""

    @abc.abstractmethod
    def begin(self, rows: Rows | None = None) -> None:
        """Begin an episode."""

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the action for the quantities of one row."""
        return act_one_by_one(observations, rows, lambda inputs, row, seed, step: self.step(inputs)[0])

    @abc.abstractmethod
    def step(self, inputs: Inputs) -> tuple[NDArray[Any], NDArray[np.float64] | None]:
        """Return the action and, where the task says what it commands, the targets."""

    @abc.abstractmethod
    def follow(
        self, inputs: Inputs, requested: NDArray[Any]
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.float64] | None]:
        """Take a step of a recorded episode: return the policy's action, and the action and targets for `requested`.

        The recorded action replaces the policy's own because the feedback of the last action and limits of acceleration
        magnify last bits from step to step.
        """


class CController(Controller):
    """A controller that `compile_controller` has compiled."""

    def __init__(self, plan: ControllerPlan, library: Path, *, has_target: bool) -> None:
        self.library = ctypes.CDLL(str(library))
        self.library.rlctl_state_size.restype = ctypes.c_size_t
        # In units of a double, so that the memory is aligned.
        self._memory = np.zeros(-(-self.library.rlctl_state_size() // 8), np.float64)
        self._pointer = self._memory.ctypes.data_as(ctypes.c_void_p)
        self._plan, self._has_target = plan, has_target
        self.action = np.zeros(plan.action_size, action_type(plan.env))
        self._target = np.zeros(plan.action_size)
        self._status = np.zeros(2, np.intc)
        self._outputs = [array.ctypes.data_as(ctypes.c_void_p) for array in (self.action, self._target, self._status)]
        self.dtype = plan.dtype
        self._values = np.zeros(plan.input_size, plan.dtype)
        self.may_send = False
        self.library.rlctl_init(self._pointer)

    @property
    def status(self) -> tuple[str, str]:
        """State and reason of the limits."""
        return STATUS[self._status[0]], REASONS[self._status[1]]

    def begin(self, rows: Rows | None = None) -> None:
        """Begin an episode, and end what the limits hold."""
        self.library.rlctl_begin(self._pointer)

    def order(self, order: str) -> None:
        """Give an order: one of `ORDERS`."""
        self.library.rlctl_order(self._pointer, ctypes.c_int(ORDERS.index(order)))

    def step(self, inputs: Inputs | None, age_s: float = 0.0) -> tuple[NDArray[Any], NDArray[np.float64] | None]:
        """Return copies of action and targets."""
        pointer = None if inputs is None else self._point_to(inputs)
        self.may_send = bool(self.library.rlctl_step(self._pointer, pointer, ctypes.c_double(age_s), *self._outputs))
        action = self.action.reshape(self._plan.action_space.shape).copy()
        return action, self._target.copy() if self._has_target else None

    def follow(
        self, inputs: Inputs, requested: NDArray[Any]
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.float64] | None]:
        """Take a step of a recorded episode."""
        own = requested.ravel().astype(self.action.dtype)
        pointers = self._point_to(inputs), own.ctypes.data_as(ctypes.c_void_p)
        self.library.rlctl_follow(self._pointer, *pointers, *self._outputs)
        target = self._target.copy() if self._has_target else None
        return own.reshape(self._plan.action_space.shape), self.action.copy(), target

    def _point_to(self, inputs: Inputs) -> ctypes.c_void_p:
        self._values[:] = np.concatenate([np.ravel(inputs[part.name]) for part in self._plan.quantities])
        return self._values.ctypes.data_as(ctypes.c_void_p)

    def limit(self, values: NDArray[np.float64] | None, age_s: float, requested: NDArray[Any] | None) -> NDArray[Any]:
        """Return the action of the limits alone, for a policy's action."""
        pointers = [None if array is None else array.ctypes.data_as(ctypes.c_void_p) for array in (values, requested)]
        outputs = self._outputs[0], self._outputs[2]
        self.library.rlctl_limit(self._pointer, pointers[0], ctypes.c_double(age_s), pointers[1], *outputs)
        return self.action

    def play(self, rows: NDArray[Any]) -> None:
        """Take a step for each row of inputs in a C loop, to measure its time; rows have shape (steps, inputs)."""
        self.library.rlctl_play(self._pointer, rows.ctypes.data_as(ctypes.c_void_p), ctypes.c_long(len(rows)))


class OnnxController(Controller):
    """A controller as an ONNX file."""

    def __init__(self, content: bytes) -> None:
        self.session = open_session(content)
        self._outputs = [port.name for port in self.session.get_outputs()]
        self._states = {
            port.name: np.zeros([1 if isinstance(size, str) else size for size in port.shape], _DTYPES[port.type])
            for port in self.session.get_inputs()
            if f"{port.name}_out" in self._outputs
        }
        self._dtypes = {port.name: _DTYPES[port.type] for port in self.session.get_inputs()}
        self.begin()

    def begin(self, rows: Rows | None = None) -> None:
        """Begin an episode: zeros in place of the state."""
        self._state = dict(self._states)

    def step(self, inputs: Inputs) -> tuple[NDArray[Any], NDArray[np.float64] | None]:
        """Return action and targets."""
        named = {name_input(name): value for name, value in inputs.items()}
        feed = {name: np.asarray(value, self._dtypes[name]).reshape(1, -1) for name, value in named.items()}
        results = dict(zip(self._outputs, self.session.run(self._outputs, feed | self._state), strict=True))
        self._state = {name: results[f"{name}_out"] for name in self._states}
        target = results.get(TARGET)
        return results[ACTION][0], None if target is None else target[0]

    def follow(
        self, inputs: Inputs, requested: NDArray[Any]
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.float64] | None]:
        """Take a step of a recorded episode."""
        action, target = self.step(inputs)
        if LAST_ACTION in self._state:
            self._state[LAST_ACTION] = requested.reshape(1, -1).astype(self._dtypes[LAST_ACTION])
        return action, action, target


class MappedController(Controller):
    """A controller with a mapping, in a program that has other values than the policy: it takes and returns these."""

    def __init__(self, controller: Controller, mapping: ProgramMapping) -> None:
        self._controller, self._mapping = controller, mapping

    def begin(self, rows: Rows | None = None) -> None:
        """Begin an episode."""
        self._controller.begin()

    def step(self, inputs: Inputs) -> tuple[NDArray[Any], NDArray[np.float64] | None]:
        """Return the action and the targets for the robot's quantities, as the policy expects them."""
        action, target = self._controller.step(self.undo(inputs))
        return action, self._read_target(target)

    def follow(
        self, inputs: Inputs, requested: NDArray[Any]
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.float64] | None]:
        """Take a step of a recorded episode."""
        own, action, target = self._controller.follow(self.undo(inputs), requested)
        return own, action, self._read_target(target)

    def undo(self, inputs: Inputs) -> Inputs:
        """Return what the program has where the robot's quantities are these."""
        maps = self._mapping.inputs
        return {name: maps[name].undo(value) if name in maps else value for name, value in inputs.items()}

    def _read_target(self, target: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        """Return the policy's targets for the program's."""
        return target if target is None or self._mapping.targets is None else self._mapping.targets.undo(target)


_DTYPES: dict[str, np.dtype[Any]] = {
    "tensor(float)": np.dtype(np.float32),
    "tensor(double)": np.dtype(np.float64),
    "tensor(int64)": np.dtype(np.int64),
}


def compile_controller(code: CSource, folder: Path, compiler: list[str]) -> Path:
    """Compile a controller in `folder` and return the library; raises `AnswerIsNo` if the compiler fails."""
    return compile_code(code, "controller", ["harness.c"], folder, compiler)  # which includes the other file
