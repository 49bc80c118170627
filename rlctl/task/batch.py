"""`BatchTask`: a task for n worlds at once, whose methods take and return arrays with a leading axis."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import ShapeError
from rlctl.task.commands import CommandTerm
from rlctl.task.sim import Sim
from rlctl.task.task import TaskDefinition

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

    def is_truncated(self) -> Any:
        """Return whether the episode ends before its time limit, as it would at the limit, shape (worlds,). Optional.

        So ends a task whose episodes differ in length, such as a clip that starts anywhere: the states after it would
        be as good as those before it, which `is_terminated` denies.
        """
        return np.zeros(self.worlds, bool)

    def next_levels(self) -> Any:
        """Return the level of the episode that follows in each world, within [0, 1], shape (worlds,). Optional.

        Read in worlds whose episode has ended, in stages whose level follows success; None: it rises and falls.
        """
        return None

    def place_reference(self) -> None:
        """Put the bodies of all worlds where the clip that the task follows has them now. Optional.

        `rlctl replay TASK --policy reference` calls it after the physics of every step.
        """

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
