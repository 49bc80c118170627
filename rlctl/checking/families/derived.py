"""RL815 and RL818 of MuJoCo: what an environment reads of the data is found by changing it.

`mj_step` leaves what is derived from positions as of the beginning of its last substep. Nothing of it takes part in the
next step, so it can be changed without changing the episode: what then changes in the observation or in the reward was
computed from it.
"""

import contextlib
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.families.model_parts import find_drift, find_untouched_parts
from rlctl.checking.families.motor_trials import find_wrong_answers
from rlctl.checking.instance import Instance
from rlctl.checking.mujoco_calls import MujocoCalls
from rlctl.checking.mujoco_trials import STEPS, Look, name_columns, pair_rows, play
from rlctl.checking.mujoco_worlds import MujocoStateReader, copy_data, library, refresh
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import RuleFinding, Severity, list_names
from rlctl.checking.values import flatten
from rlctl.checking.worlds import Array
from rlctl.environments.info import find_mujoco

DERIVED = {
    "xpos": "body", "xquat": "body", "xmat": "body", "xipos": "body", "ximat": "body", "subtree_com": "body",
    "cvel": "body", "cinert": "body", "geom_xpos": "geom", "geom_xmat": "geom", "site_xpos": "site",
    "site_xmat": "site", "xanchor": "joint", "xaxis": "joint", "ten_length": "tendon", "actuator_length": "actuator",
    "sensordata": "",
}  # fmt: skip
"""Arrays of the data that follow from positions and velocities, and what has a row of each."""
NEVER_COMPUTED = {
    "cfrc_ext": "mj_rnePostConstraint", "cfrc_int": "mj_rnePostConstraint", "cacc": "mj_rnePostConstraint",
    "qfrc_inverse": "mj_inverse", "subtree_linvel": "mj_subtreeVel", "subtree_angmom": "mj_subtreeVel",
}  # fmt: skip
"""Arrays that mj_step leaves at zero unless a sensor needs them, and what computes them."""
POLLUTION = 0.37  # An offset of what was derived before a reset
TINY = 0.01  # of what a control step changes; less is an info
FEWEST_LOOKS, LEAST_MOTION = 4, 1e-4
EXACT = 2e-6  # relative; the last bits of float32


def find_wrong_resets(instance: Instance) -> Iterator[RuleFinding]:
    """Yield what is wrong with how an environment changes its model."""
    yield from find_drift(instance)


def find_wrong_reads(
    instance: Instance, calls: MujocoCalls, reader: MujocoStateReader, plain: Sequence[Look], known: Collection[str]
) -> Iterator[RuleFinding]:
    """Yield what is wrong with how an environment reads MuJoCo's data, and moves its motors; `known` are the rules that
    have findings about the motors."""
    yield from _find_stale(instance, calls, plain)
    yield from _find_unforwarded(instance, calls, plain)
    yield from _find_never_computed(instance, calls, plain)
    yield from find_untouched_parts(instance, calls, reader)
    yield from find_wrong_answers(instance, calls, reader, known)


class _Refresh:
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

    @contextlib.contextmanager
    def as_stepped(self) -> Iterator[None]:
        """See `MujocoCalls`."""
        fresh = {name: getattr(self._data, name).copy() for name in self._old}
        for values in (self._old, fresh):
            for name, array in values.items():
                getattr(self._data, name)[:] = array
            if values is self._old:
                yield


FORWARD = (
    "Call mujoco.mj_forward(model, data) after mj_step (mj_kinematics is enough for xpos and site_xpos) and before the "
    "observation and the reward are computed."
)
FORWARD_AT_RESET = "Call mujoco.mj_forward(model, data) in reset, after qpos and qvel are written."


def _find_stale(instance: Instance, calls: MujocoCalls, plain: Sequence[Look]) -> Iterator[RuleFinding]:
    refreshing = _Refresh()
    changed = play(instance, calls, after_step=refreshing, as_stepped=refreshing.as_stepped)
    pair = pair_rows(plain, changed)
    if pair is None or len(pair[0]) < FEWEST_LOOKS:
        return
    old, new = (part[1:] for part in pair)  # a reset has no step
    off, moves = np.abs(new - old).max(axis=0), np.abs(np.diff(new, axis=0)).max(axis=0)
    columns = np.flatnonzero(off > EXACT * (1 + np.abs(new).max(axis=0))).tolist()
    if not columns:
        return
    size, fields = new.shape[1] - 1, _find_fields(instance, calls, columns)
    shown = sorted(columns, key=lambda c: c not in fields)
    texts = [f"{name_columns([c], size)}{f' ({fields[c]})' if c in fields else ''}" for c in shown]
    verb, worst = "is" if len(columns) == 1 else "are", shown[0]
    value, step = float(off[worst]), int(np.abs(new - old)[:, worst].argmax())
    what = f"{list_names(texts, 4)} {verb} computed from what mj_step leaves one substep old"
    message = f"{what}: {texts[0]} is off by up to {value:.3g}, a step changes it by up to {moves[worst]:.3g}"
    evidence = {"element": name_columns([worst], size), "seed": FIRST_SEED, "step": step + 1}
    evidence |= {"value": float(old[step, worst]), "expected": float(new[step, worst])}
    severity = Severity.WARNING if (off[columns] > TINY * moves[columns]).any() else Severity.INFO
    yield RuleFinding("RL815", message, evidence, severity, fix=FORWARD)


def _find_fields(instance: Instance, calls: MujocoCalls, columns: Sequence[int]) -> dict[int, str]:
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
    if len(rows) < FEWEST_LOOKS or len({row.shape for row in rows}) > 1:
        return fields
    features, sizes = np.array(rows) - rows[0], np.abs(rows).max(axis=0)
    moves = np.ptp(features, axis=0) > LEAST_MOTION
    for column in (column for column in columns if column < observed[0].size):
        values = np.array([row[column] for row in observed])[:, None]
        allowed = EXACT * (1 + sizes + np.abs(values).max())
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


def _find_unforwarded(instance: Instance, calls: MujocoCalls, plain: Sequence[Look]) -> Iterator[RuleFinding]:
    """Reset with other values in what is derived from positions, which a correct reset computes again."""

    def pollute(_: Any, data: Any) -> None:
        for name in DERIVED:
            getattr(data, name)[:] += POLLUTION

    def pollute_stale(_: Any, data: Any) -> None:
        for name, is_stale in stale.items():
            getattr(data, name)[is_stale] += POLLUTION

    if (simulation := find_mujoco(instance.env)) is None:
        return
    pollute(*simulation)
    pair = pair_rows(plain, play(instance, calls, 0, after_reset=pollute))
    columns = [] if pair is None else np.flatnonzero(pair[0][0] != pair[1][0]).tolist()
    if not columns:  # there is a call of mj_forward, but it may come too early
        play(instance, calls, 0)
        if stale := _find_stale_fields(instance):
            pair = pair_rows(plain, play(instance, calls, 0, after_forward=pollute_stale))
            columns = [] if pair is None else np.flatnonzero(pair[0][0] != pair[1][0]).tolist()
    if columns and pair is not None:
        size = pair[0].shape[1] - 1
        verb = "is" if len(columns) == 1 else "are"
        what = f"{name_columns(columns, size)} of reset {verb} computed before mj_forward"
        message = f"{what}: from poses and sensors as they were before qpos was written"
        evidence = {"element": name_columns(columns[:1], size), "call": "reset", "seed": FIRST_SEED}
        yield RuleFinding("RL815", message, evidence, Severity.WARNING, fix=FORWARD_AT_RESET)


def _find_stale_fields(instance: Instance) -> dict[str, NDArray[np.bool_]]:
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


def _find_never_computed(instance: Instance, calls: MujocoCalls, plain: Sequence[Look]) -> Iterator[RuleFinding]:
    zero = set(NEVER_COMPUTED)

    def note(_: Any, data: Any) -> None:
        zero.difference_update([name for name in zero if getattr(data, name).any()])

    def after_forces(name: str) -> Callable[[Any, Any], None]:
        def fill(_: Any, data: Any) -> None:
            getattr(data, name)[:] = POLLUTION

        return fill

    play(instance, calls, after_step=note)
    for name in sorted(zero):
        pair = pair_rows(plain, play(instance, calls, after_step=after_forces(name)))
        columns = [] if pair is None else np.flatnonzero((pair[0] != pair[1]).any(axis=0)).tolist()
        if columns and pair is not None:
            verb = "is" if len(columns) == 1 else "are"
            what = f"{name_columns(columns, pair[0].shape[1] - 1)} {verb} computed from data.{name}"
            message = f"{what}, which stays zero: nothing calls {NEVER_COMPUTED[name]}"
            yield RuleFinding("RL818", message, {"element": f"data.{name}", "value": 0.0})
            simulation = find_mujoco(instance.env)
            if simulation is not None:
                getattr(simulation[1], name)[:] = 0
