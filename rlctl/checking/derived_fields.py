"""The arrays of MuJoCo's data that follow from positions: `mj_step` leaves them as of its last substep's beginning.

Nothing of them takes part in the next step, so they can be changed without changing the episode: what then changes in
the observation or in the reward was computed from them.
"""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.instance import Instance
from rlctl.checking.mujoco_calls import MujocoCalls
from rlctl.checking.mujoco_trials import STEPS
from rlctl.checking.mujoco_worlds import copy_data, library, refresh
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.values import flatten
from rlctl.checking.worlds import Array
from rlctl.environments.simulations import find_mujoco

DERIVED = {
    "xpos": "body", "xquat": "body", "xmat": "body", "xipos": "body", "ximat": "body", "subtree_com": "body",
    "cvel": "body", "cinert": "body", "geom_xpos": "geom", "geom_xmat": "geom", "site_xpos": "site",
    "site_xmat": "site", "xanchor": "joint", "xaxis": "joint", "ten_length": "tendon", "actuator_length": "actuator",
    "sensordata": "",
}  # fmt: skip
"""Arrays of the data that follow from positions and velocities, and what has a row of each."""
POLLUTION = 0.37  # An offset of what was derived before a reset
FEWEST_TRIAL_LOOKS, LEAST_MOTION = 4, 1e-4
SAME_READING = 2e-6  # relative; the last bits of float32


class RefreshAfterSteps:
    """Brings poses and velocities of bodies, and the sensors of both, up to date after each step. Contacts and forces
    are left: they are of the last substep in a sense that is meant."""

    def __init__(self) -> None:
        self.fresh: list[dict[str, Array]] = []
        self._data: Any = None
        self._old: dict[str, Array] = {}

    def __call__(self, model: Any, data: Any) -> None:
        mujoco = library()
        self._data, self._old = data, {name: getattr(data, name).copy() for name in (*DERIVED, "cdof", "cdof_dot")}
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mj_tendon(model, data)
        mujoco.mj_transmission(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_sensorPos(model, data)
        mujoco.mj_sensorVel(model, data)

    def forget(self, *_: Any) -> None:
        """Keep no longer what a step left: the environment has computed it again."""
        self._old = {}

    def restore(self) -> None:
        """Put back what the last step left, for a controller that reads it in the next one."""
        for name, array in self._old.items():
            getattr(self._data, name)[:] = array
        self.forget()

    @contextlib.contextmanager
    def as_stepped(self) -> Iterator[None]:
        """See `MujocoCalls`."""
        fresh = {name: getattr(self._data, name).copy() for name in self._old}
        for values in (self._old, fresh):
            for name, array in values.items():
                getattr(self._data, name)[:] = array
            if values is self._old:
                yield


def find_fields(instance: Instance, calls: MujocoCalls, columns: Sequence[int]) -> dict[int, str]:
    """Return which derived value an element of the observation is, up to its sign and an offset that an episode keeps;
    elements that are none are left out."""
    rows: list[Array] = []
    observed: list[Array] = []
    names: list[str] = []
    for moment in EpisodePlayer(instance, FIRST_SEED, max_steps=STEPS):
        if moment.step and (simulation := find_mujoco(instance.env)) is not None:
            model, data = simulation
            rows.append(np.concatenate([np.ravel(getattr(data, name)) for name in DERIVED]))
            observed.append(np.nan_to_num(flatten(moment.observation).astype(np.float64)))
            names = names or [text for name in DERIVED for text in _name_rows(model, data, name)]
    fields: dict[int, str] = {}
    if len(rows) < FEWEST_TRIAL_LOOKS or len({row.shape for row in rows}) > 1:
        return fields
    features, sizes = np.array(rows) - rows[0], np.abs(rows).max(axis=0)
    moves = np.ptp(features, axis=0) > LEAST_MOTION
    for column in (column for column in columns if column < observed[0].size):
        values = np.array([row[column] for row in observed])[:, None]
        allowed = SAME_READING * (1 + sizes + np.abs(values).max())
        centered = values - values[0]
        near = [(np.abs(centered - sign * features) <= allowed).all(axis=0) for sign in (1.0, -1.0)]
        if (equal := moves & (near[0] | near[1])).any():
            fields[column] = names[int(equal.argmax())]
    return fields


def _name_rows(model: Any, data: Any, field: str) -> list[str]:
    array, kind = getattr(data, field), DERIVED[field]
    if field == "sensordata":
        sensors = [model.sensor(i) for i in range(model.nsensor)]
        return [f"sensor {sensor.name or sensor.id}" for sensor in sensors for _ in range(int(sensor.dim[0]))]
    names = [getattr(model, kind)(row).name or f"{kind} {row}" for row in range(len(array))]
    return [f"{field} of {name}" for name in names for _ in range(int(array[0].size))]


def find_stale_fields(instance: Instance) -> dict[str, NDArray[np.bool_]]:
    """Return which values are not what follows from the present positions and velocities, by array."""
    if (simulation := find_mujoco(instance.env)) is None:
        return {}
    model, data = simulation
    fresh = library().MjData(model)
    copy_data(fresh, model, data)
    refresh(model, fresh)
    differ = {name: ~np.isclose(getattr(data, name), getattr(fresh, name), 1e-6, 1e-6) for name in DERIVED}
    for number in range(model.nsensor):  # those that only a step computes
        sensor = model.sensor(number)
        if int(sensor.needstage[0]) == int(library().mjtStage.mjSTAGE_ACC):
            differ["sensordata"][int(sensor.adr[0]) : int(sensor.adr[0]) + int(sensor.dim[0])] = False
    return {name: is_stale for name, is_stale in differ.items() if is_stale.any()}
