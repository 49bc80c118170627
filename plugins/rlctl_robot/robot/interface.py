"""What a program gets and returns: a policy's observation and action, or a controller's inputs and targets."""

import abc
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.info import EnvInfo
from rlctl.errors import short_repr
from rlctl.exporting.controller.observation import ControllerObservation
from rlctl.exporting.controller.plan import ControllerPlan
from rlctl.limits.observation import ObservationReader
from rlctl.policy.named_actors import ZeroActor

Array = NDArray[Any]
Parts = Mapping[str, Array]


class Interface(abc.ABC):
    """What a robot sends and takes, by name; `env` is its environment."""

    answer = "action"
    """What a command is, in words."""

    def __init__(self, env: Any, info: EnvInfo) -> None:
        self._env, self._info, self._space = env, info, env.action_space
        self._reader = ObservationReader(info)
        self.shapes: dict[str, tuple[int, ...]] = self._reader.shapes
        """The shape of each part of what is sent, in its order."""
        self.units = dict(info.observation_units)
        self._zero = ZeroActor(self._space).action

    @property
    def sizes(self) -> tuple[int, int] | None:
        """Numbers that are sent and taken; None for images and discrete actions, which are not vectors of numbers."""
        is_vector = isinstance(self._space, spaces.Box) and all(len(shape) < 2 for shape in self.shapes.values())
        if not is_vector or list(self._reader.layout.columns) != list(self._reader.shapes):
            return None
        return sum(map(math.prod, self.shapes.values())), math.prod(self._space.shape or ())

    @abc.abstractmethod
    def measure(self, observation: Any) -> dict[str, Array]:
        """Return what the sensors measure when the environment has returned `observation`."""

    @abc.abstractmethod
    def read(self, values: Any) -> Array:
        """Return a command; raises `ValueError` with the reason for what is none."""

    @abc.abstractmethod
    def find_action(self, command: Array | None, measured: Parts, step: int) -> Array:
        """Return the environment's action for the newest command; None: none has come in this episode."""

    @abc.abstractmethod
    def begin(self) -> None:
        """Begin to compute what the policy observes in an episode."""

    @abc.abstractmethod
    def observe(self, sent: Parts, step: int) -> Any:
        """Return the policy's observation for what was sent in a step."""

    @abc.abstractmethod
    def find_command(self, action: Array, sent: Parts, step: int) -> Array:
        """Return the command of a policy's action for what was sent."""


class PolicyInterface(Interface):
    """The observation of the policy, and its action."""

    def measure(self, observation: Any) -> dict[str, Array]:
        """Return the parts of the observation by name."""
        return self._reader.name_parts(observation)

    def read(self, values: Any) -> Array:
        """Return an action within its bounds."""
        return read_action(values, self._space)

    def find_action(self, command: Array | None, measured: Parts, step: int) -> Array:
        """Return the action itself."""
        return self._zero if command is None else command

    def begin(self) -> None:
        """Nothing is computed."""

    def observe(self, sent: Parts, step: int) -> Any:
        """Return what was sent, in the policy's form."""
        return self._reader.read(sent)

    def find_command(self, action: Array, sent: Parts, step: int) -> Array:
        """Return the action itself."""
        return action


class ControllerInterface(Interface):
    """The inputs and the targets of `rlctl export --controller`; actions where the task says no targets.

    Raises `UsageError` for an environment that has no controller.
    """

    def __init__(self, env: Any, info: EnvInfo) -> None:
        super().__init__(env, info)
        self._controller = ControllerPlan(info)
        self._target = self._controller.target
        self.shapes = {part.name: (part.size,) for part in self._controller.quantities}
        self.units = {part.name: part.unit for part in self._controller.quantities if part.unit}
        if self._target is not None:
            self.answer = f"joint {self._target.interface} [{self._target.unit}]"
        self._observation = ControllerObservation(self._controller)
        self._last_action = np.zeros(math.prod(self._space.shape or ()))

    def measure(self, observation: Any) -> dict[str, Array]:
        """Return the quantities, in the type of the controller's inputs."""
        terms = getattr(self._env.unwrapped, "measured", {})
        measured = self._controller.measure(observation, terms)
        return {name: value.astype(self._controller.dtype) for name, value in measured.items()}

    def read(self, values: Any) -> Array:
        """Return the targets of the joints, which have no bounds here, or an action."""
        if self._target is None:
            return read_action(values, self._space)
        return _read_vector(values, len(self._target.factor), "a target")

    def find_action(self, command: Array | None, measured: Parts, step: int) -> Array:
        """Return the action that sends the joints from where they are now to the targets."""
        if command is None or self._target is None:
            return self._zero if command is None else command
        action = self._target.find_action(measured, command, step)
        return np.clip(action, self._space.low, self._space.high).astype(self._space.dtype)

    def begin(self) -> None:
        """Empty the histories."""
        self._observation.begin()
        self._last_action = np.zeros_like(self._last_action)

    def observe(self, sent: Parts, step: int) -> Any:
        """Return the observation as a controller computes it; the last action is the policy's own."""
        parts = self._observation.observe(sent, step, self._last_action)
        return self._reader.read({name: parts[name] for name in self._reader.shapes})

    def find_command(self, action: Array, sent: Parts, step: int) -> Array:
        """Return the joints' targets for an action."""
        self._last_action = np.ravel(action)
        return action if self._target is None else self._target.find_targets(sent, action, step)


def read_action(values: Any, space: spaces.Space[Any]) -> Array:
    """Return a command as an action, clipped to the bounds; raises `ValueError` with the reason if it is none."""
    shape = space.shape or ()
    action = _read_vector(values, math.prod(shape), "an action").reshape(shape)
    if isinstance(space, spaces.Box):
        return np.clip(action, space.low, space.high).astype(space.dtype)
    if not space.contains(action := action.astype(space.dtype)):
        raise ValueError(f"{short_repr(action.tolist())} is not in {space}")
    return action


def _read_vector(values: Any, size: int, what: str) -> Array:
    try:
        vector = np.asarray(values)
        if vector.dtype.kind not in "biuf" or vector.size != size:
            raise ValueError
    except (ValueError, TypeError):
        raise ValueError(f"{short_repr(values)} is not {what} of {size} numbers") from None
    if not np.isfinite(vector).all():
        raise ValueError(f"the {what.split()[-1]} is not finite: {short_repr(vector.tolist())}")
    return vector.astype(np.float64).ravel()
