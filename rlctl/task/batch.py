"""`BatchTask`: a task for n worlds at once, whose methods take and return arrays with a leading axis."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import ShapeError, TaskError
from rlctl.task.commands import CommandTerm
from rlctl.task.joints import Joints
from rlctl.task.sim import Sim
from rlctl.task.task import Task, TaskDefinition

Array = NDArray[np.float64]


class WorldRngs:
    """The random generators of the worlds that begin an episode; every draw has a row per world.

    It has the methods of `numpy.random.Generator`: `rng.uniform(-1, 1, 12)` has the shape (worlds, 12). Each row comes
    from that world's own generator, so that an episode depends on its seed alone.
    """

    def __init__(self, generators: Sequence[np.random.Generator]) -> None:
        self._generators = generators

    def __getattr__(self, method: str) -> Callable[..., NDArray[Any]]:
        if method.startswith("__") or not hasattr(np.random.Generator, method):
            raise AttributeError(f"numpy.random.Generator has no method {method!r}")
        return lambda *args, **kwargs: np.array([getattr(rng, method)(*args, **kwargs) for rng in self._generators])


class BatchTask(TaskDefinition):
    """A task for `worlds` worlds of one model, simulated together in MuJoCo.

    Definition and parameters are those of `Task`. The methods see all worlds: arrays of bodies have the shape
    (worlds, ...), and so have all that are returned. `build` is called once and builds one world, which is copied.
    """

    worlds: int
    """Number of worlds; set before `build`."""
    per_world: ClassVar[Mapping[str, tuple[int, ...]]] = {}
    """Attributes that keep a value per world between steps, and the shape of a value: `{"command": (3,), "time": ()}`.

    Each is an array of shape (worlds, ...), 0 at the start of an episode.
    """

    def reset(self, rng: WorldRngs, worlds: NDArray[np.int64]) -> None:
        """Start an episode in `worlds`, shape (k,), and leave the others alone; draws from `rng` have k rows."""

    def act(self, action: NDArray[Any]) -> None:
        """Set motor targets from actions of shape (worlds, ...) inside `action_space`."""
        raise NotImplementedError

    def observe(self) -> dict[str, Any]:
        """Return what the policy sees, by name, each of shape (worlds, size)."""
        raise NotImplementedError

    def rewards(self, action: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return the raw reward terms, each of shape (worlds,), by the names of `reward_weights`."""
        raise NotImplementedError

    def privileged(self) -> dict[str, NDArray[np.float64]]:
        """Return what only a critic sees, by name, each of shape (worlds, size); see `Task.privileged`. Optional."""
        return {}

    def is_success(self) -> Any:
        """Return whether the goal is reached now, shape (worlds,). Optional."""
        return None

    def is_terminated(self) -> Any:
        """Return whether the episode ends, shape (worlds,). Optional."""
        return np.zeros(self.worlds, bool)

    def markers(self) -> dict[str, NDArray[np.float64]]:
        """Return points to draw: name -> world positions of shape (worlds, 3) [m]. Optional."""
        return {}

    def commands(self) -> dict[str, CommandTerm]:
        """Return what a person may command, by name, in the order of the keys; values of shape (worlds,). Optional."""
        return {}

    def set_commands(self, values: Mapping[str, Array]) -> None:
        """Set some of the `commands`, values of shape (worlds,), within their ranges; `reset` may draw others."""
        raise NotImplementedError

    def prepare(self, sim: Sim, worlds: int) -> None:
        """Set the number of worlds and the attributes of `per_world`, and build the world. rlctl calls it."""
        self.sim, self.worlds, self.level = sim, worlds, np.ones(worlds)
        for name, shape in self.per_world.items():
            setattr(self, name, np.zeros((worlds, *shape)))
        self.build(sim)

    def clear_kept(self, worlds: NDArray[np.int64]) -> None:
        """Set the attributes of `per_world` to 0 in some worlds."""
        for name in self.per_world:
            getattr(self, name)[worlds] = 0


class OneWorld(Task):
    """A `BatchTask` with one world as a `Task`: without the leading axis."""

    batch: BatchTask

    def __getattr__(self, name: str) -> Any:
        if name == "batch":
            raise AttributeError(name)
        return getattr(self.batch, name)

    def build(self, sim: Sim) -> None:
        self.batch.prepare(sim.batch, 1)  # type: ignore[attr-defined]  # a `OneWorldSim`

    def reset(self, rng: np.random.Generator) -> None:
        self.batch.clear_kept(np.zeros(1, np.int64))
        self.batch.reset(WorldRngs([rng]), np.zeros(1, np.int64))

    @property
    def level(self) -> float:
        """How hard the next episode is; see `TaskDefinition.level`."""
        return float(self.batch.level[0])

    @level.setter
    def level(self, value: float) -> None:
        self.batch.level[:] = value

    def act(self, action: NDArray[Any]) -> None:
        self.batch.act(np.asarray(action)[None])

    def observe(self) -> dict[str, Any]:
        return self._read("observe", self.batch.observe(), 2)

    def privileged(self) -> dict[str, NDArray[np.float64]]:
        return self._read("privileged", self.batch.privileged(), 2)

    def rewards(self, action: NDArray[Any]) -> dict[str, float]:
        terms = self._read("rewards", self.batch.rewards(np.asarray(action)[None]), 1)
        return {name: float(value) for name, value in terms.items()} if isinstance(terms, dict) else terms

    def is_terminated(self) -> bool:
        return bool(read_rows(self._name, "is_terminated()", self.batch.is_terminated(), (1,), bool)[0])

    def markers(self) -> dict[str, NDArray[np.float64]]:
        return self._read("markers", self.batch.markers(), 2)

    @property
    def _name(self) -> str:
        return type(self).__name__

    def commands(self) -> dict[str, CommandTerm]:
        return {name: command._replace(value=command.value[0]) for name, command in self.batch.commands().items()}

    def set_commands(self, values: Mapping[str, float]) -> None:
        self.batch.set_commands({name: np.array([value]) for name, value in values.items()})

    def _read(self, method: str, values: Any, axes: int) -> Any:
        """Return the row of each array; what is not a dict is left to `TaskEnv`."""
        if not isinstance(values, dict):
            return values

        def read(name: str, value: Any) -> Any:
            if isinstance(value, tuple):  # the quantities of a term
                return tuple(read(name, quantity) for quantity in value)
            return read_rows(self._name, f"{method}()[{name!r}]", value, (1, None)[:axes], np.float64)[0]

        return {name: read(name, value) for name, value in values.items()}

    def describe_joints(self) -> Joints | None:
        return self.batch.describe_joints()


def _is_success(self: OneWorld) -> bool:
    return bool(read_rows(self._name, "is_success()", self.batch.is_success(), (1,), bool)[0])


def read_rows(task: str, where: str, value: Any, shape: tuple[int | None, ...], dtype: type) -> NDArray[Any]:
    """Return what a method of a `BatchTask` returned as an array; raises `ShapeError` unless it has a row per world.

    None in `shape`, after the first axis, is any size. Numbers are converted to `dtype`; flags must be `bool`.
    """
    array = np.asarray(value)
    fits = array.shape == shape or (None in shape and array.ndim == len(shape) and len(array) == shape[0])
    if not fits or array.dtype.kind not in ("b" if dtype is bool else "fiub"):
        sizes = ", ".join("size" if size is None else str(size) for size in shape) + ("," if len(shape) == 1 else "")
        what = "bool" if dtype is bool else "numbers"
        raise ShapeError(
            f"{task}: {where} is an array of {array.dtype} of shape {array.shape}, expected {what} of shape ({sizes}): "
            "a row per world"
        )
    return array.astype(dtype, copy=False)


def as_single(task: Task | BatchTask) -> Task:
    """Return a task for one world: a `BatchTask` without its leading axis, any other as it is."""
    if not isinstance(task, BatchTask):
        return task
    required = ("build", "act", "observe", "rewards")
    missing = [f"{name}()" for name in required if getattr(type(task), name) is getattr(BatchTask, name)]
    if missing:
        raise TaskError(
            f"{type(task).__name__} does not define {', '.join(missing)}; a task needs {', '.join(required)}"
        )
    values = {
        name: getattr(task, name) for name in TaskDefinition.__annotations__ if name != "level" and hasattr(task, name)
    }
    if type(task).is_success is not BatchTask.is_success:
        values["is_success"] = _is_success
    single: Task = type(type(task).__name__, (OneWorld,), values | {"__doc__": type(task).__doc__})()
    single.batch = task  # type: ignore[attr-defined]
    return single
