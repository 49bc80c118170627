"""The model and the state of one world or of many: MuJoCo's arrays by name, steps, resets, what a reset restores."""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import UsageError, WorldFailed
from rlctl.library_output import print_mujoco_warnings
from rlctl.task.mujoco.ideal_motors import IdealMotors
from rlctl.task.world_index import WorldIndex

Array = NDArray[np.float64]

_SERIOUS = {
    "mjWARN_BADQPOS": "positions are not finite or too large",
    "mjWARN_BADQVEL": "velocities are not finite or too large",
    "mjWARN_BADQACC": "accelerations are not finite or too large",
    "mjWARN_INERTIA": "the inertia matrix is singular",
    "mjWARN_CNSTRFULL": "too many constraints",
}
"""MuJoCo's warnings that are errors, and what they mean."""
_DERIVED = ("xpos", "xquat", "xipos", "qfrc_bias")
"""Arrays that bodies and motors read and the state does not have."""
_OF_STEPS = ("sensordata", "actuator_force", "qfrc_actuator")
"""Those that only a step computes; after any other call a world of a batch has those of another world."""


OLDEST_FOR_TASKS, OLDEST_FOR_BATCHES = "3.17", "4"
"""Versions of MuJoCo. Plain Gymnasium environments run with older ones too, see pyproject.toml."""


def import_mujoco() -> Any:
    """Import MuJoCo; raises `UsageError` where it is missing."""
    try:
        import mujoco
    except ImportError:
        raise UsageError("MuJoCo is not installed: pip install mujoco") from None
    print_mujoco_warnings()
    # Of meshes whose textures MuJoCo leaves out.
    warnings.filterwarnings("ignore", "obj_decoder: invalid or missing face texture coordinate")
    return mujoco


@contextlib.contextmanager
def hide_instability() -> Iterator[None]:
    """Leave out MuJoCo's warnings of unstable simulations, which are expected among the candidates of a search."""
    mujoco = import_mujoco()
    show = mujoco.get_mju_user_warning()

    def filter_warning(text: str) -> None:
        if "The simulation is unstable" not in text:
            show(text)

    mujoco.set_mju_user_warning(filter_warning)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(show)


def _too_old(what: str, needed: str) -> UsageError:
    installed = importlib.metadata.version("mujoco")
    return UsageError(f"{what} needs MuJoCo {needed} or later, and {installed} is installed: pip install -U mujoco")


class MujocoWorld:
    """One world of a model, or `count` worlds that `mujoco.batch` steps with one call of C.

    `data(name)` and `model(name)` are arrays of MjData and MjModel: those of one world without `count`; with it they
    have a leading axis. `extra` are arrays of ours that a reset restores like those of the model. While the model is
    built (`batch` is None) there is one world, with a leading axis of 1 if `count` is given.
    """

    def __init__(self, substeps: int, count: int | None = None) -> None:
        self.mujoco = import_mujoco()
        if not hasattr(self.mujoco.mjtIntegrator, "mjINT_DISCRETE"):  # see `scene.py`
            raise _too_old("a task in MuJoCo", OLDEST_FOR_TASKS)
        if count is not None and count > 1 and importlib.util.find_spec("mujoco.batch") is None:
            raise _too_old("a batch of worlds", OLDEST_FOR_BATCHES)
        self.substeps, self.count = substeps, count
        self.mj_model: Any
        self.mj_data: Any
        self._scratch: Any = None
        self.batch: Any = None
        self.extra: dict[str, Array] = {}
        """Arrays by name, without the leading axis of worlds."""
        self.ideal = IdealMotors(self)
        self._built: dict[str, Array] = {}  # values of the built world, of arrays that may have changed
        self._rows: dict[str, Array] = {}  # arrays of `extra` with a row per world
        self._of_steps: dict[str, Array] = {}  # arrays of `_OF_STEPS` of a batch, since the last step or reset
        self._saved: Array | None = None
        self._iterations = 0  # of the solver in the built world
        self._is_fresh = False  # whether all that depends on positions and velocities is up to date
        self._stale: set[int] = set()  # worlds of a batch for which it is not

    def set_model(self, model: Any, data: Any) -> None:
        """Use a newly compiled model; there is one world until `save`."""
        self.mj_model, self.mj_data, self._scratch = model, data, None
        self.batch, self._saved, self._is_fresh = None, None, False
        self._built.clear()
        self._rows.clear()

    @property
    def scratch(self) -> Any:
        """A second MjData of the model, to compute with other positions; what is in it is of the last use."""
        if self._scratch is None:  # to make one takes as long as some physics steps
            self._scratch = self.mujoco.MjData(self.mj_model)
        return self._scratch

    def data(self, name: str) -> Any:
        """Return an array of MjData; those that are derived are valid after `refresh`."""
        if self.batch is not None:
            return self._of_steps[name] if name in _OF_STEPS else self.batch.bind(name)
        array = getattr(self.mj_data, name)
        return array if self.count is None else array[None]

    def model(self, name: str) -> Any:
        """Return an array of MjModel (`opt.gravity` of its options), or of `extra`, with the values of each world.

        Before `save` a change belongs to the built world; later a reset takes it back.
        """
        if name not in self._built and self._saved is not None:
            self._built[name] = self._find(name).copy()
        if self.batch is not None:
            if name not in self.extra:
                return self.batch.expand(name)
            if name not in self._rows:
                self._rows[name] = np.repeat(self.extra[name][None], self.batch.nsim, axis=0)
            return self._rows[name]
        array = self._find(name)
        return array if self.count is None else array[None]

    def _find(self, name: str) -> Array:
        if name in self.extra:
            return self.extra[name]
        owner = self.mj_model.opt if name.startswith("opt.") else self.mj_model
        array: Array = getattr(owner, name.removeprefix("opt."))
        return array

    def model_row(self, name: str, row: int) -> Array:
        """Return an array of `model` of one world, for reading only: one that all worlds share stays shared."""
        if self.batch is None:
            return self._find(name)
        rows = self._rows.get(name) if name in self.extra else self.batch.expanded(name)
        array: Array = self._find(name) if rows is None else rows[row]
        return array

    def data_row(self, name: str, row: int) -> Array:
        """Return an array of the state of one world, for reading only."""
        array: Array = getattr(self.mj_data, name) if self.batch is None else self.batch.bind(name)[row]
        return array

    def built(self, name: str) -> Array:
        """Return the values of the built world of an array of `model`, without a leading axis."""
        return self._built[name] if name in self._built else self._find(name)

    def touch(self, world: Any = None) -> None:
        """Note that the state, or the model, of a world (index or numbers; None: all) has changed."""
        if self.batch is None:
            self._is_fresh = False
        elif world is None:
            self._stale.update(range(self.batch.nsim))
        else:
            self._stale.update(np.atleast_1d(world).tolist())

    def refresh(self) -> None:
        """Compute what depends on the present positions and velocities."""
        if self.batch is None:
            if not self._is_fresh:
                self.mujoco.mj_step1(self.mj_model, self.mj_data)
                self._is_fresh = True
        elif self._stale:
            ids = np.array(sorted(self._stale), np.int32)
            self._stale.clear()
            self._call("forward", ids, stage=self._velocity_stage)

    @property
    def _velocity_stage(self) -> int:
        return int(self.mujoco.mjtStage.mjSTAGE_VEL)

    def _call(self, method: str, ids: Any, **values: Any) -> None:
        from mujoco.batch import SimulationError

        try:
            getattr(self.batch, method)(ids, **values)
        except SimulationError as error:
            raise WorldFailed(f"MuJoCo: {self.batch.error(int(error.ids[0]))}", int(error.ids[0])) from None

    def step(self, worlds: WorldIndex | None = None) -> None:
        """Take all substeps of a control step; afterwards everything but accelerations and forces is up to date."""
        if self.batch is not None:
            ids = None if worlds is None else np.sort(worlds).astype(np.int32)
            self._stale.difference_update(range(self.batch.nsim) if worlds is None else worlds.tolist())
            self._call("step", ids, nstep=self.substeps, stage=self._velocity_stage)
            rows: Any = slice(None) if worlds is None else worlds
            for name, values in self._of_steps.items():
                values[rows] = self.batch.bind(name)[rows]
            if self.batch.warning.any():
                self._raise_warning()
            return
        mujoco, model, data = self.mujoco, self.mj_model, self.mj_data
        if not self._is_fresh:
            mujoco.mj_step1(model, data)
        if self.ideal.is_used:
            self.ideal.step(self.substeps)
        else:
            # The same as `substeps` calls of mj_step, but the last one leaves what is derived up to date.
            mujoco.mj_step2(model, data)
            if self.substeps > 1:
                mujoco.mj_step(model, data, nstep=self.substeps - 1)
            mujoco.mj_step1(model, data)
        self._is_fresh = True
        if data.warning.number.any():
            self._raise_warning()

    def _raise_warning(self) -> None:
        # Of a batch: the last value and the number of each warning.
        rows = self.batch.warning[..., 1] if self.batch is not None else self.mj_data.warning.number[None].copy()
        for name, what in _SERIOUS.items():
            bad = np.flatnonzero(rows[:, int(getattr(self.mujoco.mjtWarning, name))])
            if bad.size:
                raise WorldFailed(f"MuJoCo: {what}: the simulation is unstable", int(bad[0]))
        if self.batch is None:
            self.mj_data.warning.number[:] = 0
        else:
            self.batch.warning[:] = 0

    def read_sensor(self, name: str) -> Array:
        """Return a copy of a sensor's values, shape (size,); forces and accelerations are 0 after a reset."""
        self.refresh()
        sensor = self.mj_model.sensor(name)
        start, size = int(sensor.adr[0]), int(sensor.dim[0])
        # Sensors of positions and velocities are up to date after `refresh`, the others since the last step.
        is_of_steps = int(sensor.needstage[0]) == int(self.mujoco.mjtStage.mjSTAGE_ACC)
        row = self.data("sensordata") if self.batch is None or is_of_steps else self.batch.bind("sensordata")
        values: Array = row[..., start : start + size].copy()
        return values

    def read_contact_distances(self, world: int) -> Array:
        """Return the distances of the bodies at the contacts of a world [m], negative where they overlap."""
        if self.batch is None:
            self.refresh()
        else:
            # Bodies that are fixed may stand elsewhere in each world; all else that is theirs moves no contact.
            is_moved = self.batch.expanded("body_pos") is not None
            model = self.batch.get_model(world) if is_moved else self.mj_model
            self.batch.get_data(world, self.mj_data)
            self.mujoco.mj_fwdPosition(model, self.mj_data)
        distances: Array = self.mj_data.contact.dist.copy()
        return distances

    def solve_further(self, iterations: int) -> None:
        """Let the solver of a single world take at least so many iterations, until the next reset.

        The worlds of a batch share their options, which do not change.
        """
        if self.batch is None and self._saved is not None:
            option = self.mj_model.opt
            option.iterations = max(option.iterations, iterations)

    def save(self) -> None:
        """Save the built world for `restore`, and make `count` copies of it."""
        mujoco = self.mujoco
        kind = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        self._saved = np.empty(mujoco.mj_stateSize(self.mj_model, kind))
        mujoco.mj_getState(self.mj_model, self.mj_data, self._saved, kind)
        self._built.clear()
        self._iterations = self.mj_model.opt.iterations
        if self.count is not None and self.count > 1:
            from mujoco.batch import Batch

            self.batch = Batch(self.mj_model, self.count, 1)
            self.batch.state[:] = self._saved
            for name in _DERIVED:  # one that is bound later is zero until the next call
                self.batch.bind(name)
            self._of_steps = {name: np.zeros_like(self.batch.bind(name)) for name in _OF_STEPS}
            self.touch()

    def restore(self, worlds: WorldIndex | None = None) -> None:
        """Restore the saved world, or some of the worlds, with the model as it was built; bit for bit."""
        rows: Any = slice(None) if worlds is None else worlds
        for name, values in self._built.items():
            self.model(name)[rows if self.count is not None else ...] = values
        if self.batch is not None:
            self.batch.state[rows] = self._saved
            self.batch.warning[rows] = 0
            for values in self._of_steps.values():
                values[rows] = 0.0
        else:
            mujoco = self.mujoco
            self.mj_model.opt.iterations = self._iterations
            mujoco.mj_resetData(self.mj_model, self.mj_data)
            kind = int(mujoco.mjtState.mjSTATE_INTEGRATION)
            mujoco.mj_setState(self.mj_model, self.mj_data, self._saved, kind)
        self.touch(worlds)

    @contextlib.contextmanager
    def keep(self, worlds: NDArray[np.int64]) -> Iterator[None]:
        """Take back what the block of a `with` changes in some worlds of a batch: their state and their model."""
        state = self.batch.state[worlds]
        fields = {name: self.model(name)[worlds] for name in self._built}
        try:
            yield
        finally:
            has_changed = not np.array_equal(self.batch.state[worlds], state)
            self.batch.state[worlds] = state
            for name, built in self._built.items():
                values = self.model(name)
                before = fields.get(name, built)  # one that the block has used first was as it was built
                if not _is_same(values[worlds], before):
                    has_changed = True
                    values[worlds] = before
            if has_changed:
                self.touch(worlds)


def _is_same(values: Array, before: Array) -> bool:
    """Return whether arrays that can be broadcast are equal; NaN equals NaN."""
    is_equal = values == before
    if is_equal.all():  # nearly always, and several times as fast as the comparison of NaN
        return True
    is_missing = np.isnan(values) & np.isnan(before)
    return bool((is_equal | is_missing).all())


class Fields:
    """The arrays that a body reads and writes: those of all worlds, or of one of them without the leading axis."""

    def __init__(self, world: MujocoWorld, index: int | None = None) -> None:
        self.world = world
        self.index = index
        self._cache: dict[str, Any] = {}

    def forget(self) -> None:
        """Look the arrays up again: the model has been compiled."""
        self._cache.clear()

    def data(self, name: str) -> Any:
        """Return an array of the state; see `MujocoWorld.data`."""
        array = self._cache.get(name)
        if array is None:
            array = self._cache[name] = self._select(self.world.data(name))
        return array

    def derived(self, name: str) -> Any:
        """Return an array that is computed from the state, up to date."""
        self.world.refresh()
        return self.data(name)

    def sensor(self, name: str) -> Array:
        """Return the values of a sensor, shape (size,); see `MujocoWorld.read_sensor`."""
        values: Array = self._select(self.world.read_sensor(name))
        return values

    def model(self, name: str) -> Any:
        """Return an array of the model, for reading and writing, as of the world. Call `touch` after a change."""
        return self._select(self.world.model(name))

    def _select(self, array: Any) -> Any:
        return array if self.index is None else array[self.index]

    def touch(self, worlds: WorldIndex | None = None) -> None:
        """Note a change of the state or the model."""
        self.world.touch(self.index if worlds is None else worlds)

    @property
    def shape(self) -> tuple[int, ...]:
        """The leading axis: (n,) for the worlds of a batch, else ()."""
        return () if self.index is not None or self.world.count is None else (self.world.count,)
