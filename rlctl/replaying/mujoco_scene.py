"""The scene of an episode in a MuJoCo environment: the geoms of its model, moved by its state."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.mujoco_model import find_mujoco, joint_name
from rlctl.replaying.mjcf import Mesh, Shape, ShapeKind
from rlctl.replaying.scene import BodyMotion, Env, Scene
from rlctl.task.env import TaskEnv

if TYPE_CHECKING:
    import mujoco

Array = NDArray[np.float64]

_VISIBLE_GROUPS = 3  # of geoms: those that MuJoCo's viewer shows; the others are for collisions
_GROUND_SIZE = 8.0  # [m]
_RAIL = 100.0  # [m]; a sliding joint that is longer has no limits
_SHORTEST_PATH = 0.3  # [m]; a body that moves less is not a trunk
_NO_COLOR = [0.5, 0.5, 0.5, 1.0]  # of a geom that has a material, or none
_XYZW = [1, 2, 3, 0]


@dataclasses.dataclass(frozen=True)
class _State:
    """The part of the state that determines the poses of all bodies."""

    qpos: Array
    qvel: Array
    mocap_pos: Array
    mocap_quat: Array


class MujocoReader:
    """Reads the state after every step, without changing it."""

    def __init__(self, env: Env) -> None:
        self._env = env
        self._states: list[_State] = []
        self._markers: dict[str, list[Array]] = {}

    def read(self, step: int) -> None:
        """Read the world after a step; 0 is the reset."""
        if step == 0:  # only now: a reset may load the model again
            self._states, self._markers = [], {}
        self._model, data = find_mujoco(self._env)  # type: ignore[misc]
        self._states.append(_State(*(getattr(data, field.name).copy() for field in dataclasses.fields(_State))))
        inner = self._env.unwrapped
        if isinstance(inner, TaskEnv):
            markers = inner.task.markers()
        else:
            goal = getattr(inner, "goal", None)
            markers = {"goal": goal} if isinstance(goal, np.ndarray) and goal.shape == (3,) else {}
        for name, position in markers.items():
            self._markers.setdefault(name, []).append(np.array(position, np.float64))

    def scene(self) -> Scene:
        """Return what was read since the last reset."""
        grounds = _find_ground(self._model)
        bodies = [_describe_ground(self._model, geom, len(self._states)) for geom in grounds]
        robot, sites = _move_bodies(self._model, self._states, grounds)
        complete = {name: np.stack(rows) for name, rows in self._markers.items() if len(rows) == len(self._states)}
        return Scene([*bodies, robot], complete or sites)


def _find_ground(model: mujoco.MjModel) -> list[int]:
    import mujoco

    # MuJoCo 4's enums can be compared with integers only after conversion.
    plane, box = (model.geom_type == int(kind) for kind in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX))
    wide = box & (model.geom_size[:, :2].min(axis=1) > _GROUND_SIZE / 2)  # what PyBullet's plane.urdf is
    fixed = (model.body_weldid[model.geom_bodyid] == 0) & (model.geom_group < _VISIBLE_GROUPS)
    return [int(geom) for geom in np.flatnonzero((plane | wide) & fixed)]


def _describe_ground(model: mujoco.MjModel, geom: int, rows: int) -> BodyMotion:
    name = model.geom(geom).name or f"plane {geom}"
    return BodyMotion(
        name=name,
        file=Path(name),
        ground_height=_find_height(model, geom),
        terrain=None,
        joint_names=[],
        joint_positions=np.zeros((rows, 0)),
        joint_velocities=np.zeros((rows, 0)),
        links=[name],
        positions=np.zeros((rows, 1, 3)),
        orientations=np.tile([0.0, 0.0, 0.0, 1.0], (rows, 1, 1)),
        shapes=[],
        trunk=None,
        box=(-np.ones(3), np.ones(3)),
    )


def _find_height(model: mujoco.MjModel, geom: int) -> float:
    import mujoco

    scratch = mujoco.MjData(model)
    mujoco.mj_kinematics(model, scratch)
    thickness = model.geom_size[geom][2] if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_BOX) else 0.0
    return float(scratch.geom_xpos[geom][2] + thickness)


def _move_bodies(
    model: mujoco.MjModel, states: list[_State], grounds: list[int]
) -> tuple[BodyMotion, dict[str, Array]]:
    """Return the motion of all bodies, and of the sites named goal or target."""
    import mujoco

    scratch = mujoco.MjData(model)
    shown = [geom for geom in range(model.ngeom) if model.geom_group[geom] < _VISIBLE_GROUPS and geom not in grounds]
    names = {model.site(site).name: site for site in range(model.nsite)}
    sites = {name: site for name, site in names.items() if "goal" in name or "target" in name}
    site_positions: dict[str, list[Array]] = {name: [] for name in sites}
    positions = np.empty((len(states), model.nbody, 3))
    orientations = np.empty((len(states), model.nbody, 4))
    centers = np.zeros((len(shown), 3))
    for step, state in enumerate(states):
        # After a step `xpos` is where bodies were before its last substep.
        scratch.qpos[:], scratch.mocap_pos[:], scratch.mocap_quat[:] = state.qpos, state.mocap_pos, state.mocap_quat
        mujoco.mj_kinematics(model, scratch)
        positions[step], orientations[step] = scratch.xpos, scratch.xquat[:, _XYZW]
        for name, site in sites.items():
            site_positions[name].append(scratch.site_xpos[site].copy())
        if step == 0:
            centers = scratch.geom_xpos[shown].copy()
    slide = int(mujoco.mjtJoint.mjJNT_SLIDE)
    joints = [joint for joint in range(model.njnt) if model.jnt_type[joint] >= slide]  # sliding ones and hinges
    links = [model.body(body).name or f"body {body}" for body in range(model.nbody)]
    trunk = _find_trunk(model, positions)
    moving = [index for index, geom in enumerate(shown) if trunk is None or model.geom_bodyid[geom]] or [0]
    radii = model.geom_rbound[shown][:, None] if shown else np.ones((1, 1))
    centers = centers if shown else np.zeros((1, 3))
    robot = BodyMotion(
        name="robot",
        file=Path("MuJoCo model"),
        ground_height=None,
        terrain=None,
        joint_names=[joint_name(model, joint) for joint in joints],
        joint_positions=np.stack([state.qpos[model.jnt_qposadr[joints]] for state in states]),
        joint_velocities=np.stack([state.qvel[model.jnt_dofadr[joints]] for state in states]),
        links=links,
        positions=positions,
        orientations=orientations,
        shapes=[shape for geom in shown if (shape := _describe_shape(model, geom, links)) is not None],
        trunk=trunk,
        box=((centers - radii)[moving].min(axis=0), (centers + radii)[moving].max(axis=0)),
    )
    return robot, {name: np.stack(history) for name, history in site_positions.items()}


def _find_trunk(model: mujoco.MjModel, positions: Array) -> int | None:
    """Return the first body that travels on a free joint, or on a sliding joint without limits."""
    import mujoco

    free, slide = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    for joint in range(model.njnt):
        kind, body = int(model.jnt_type[joint]), int(model.jnt_bodyid[joint])
        endless = kind == slide and not 0 < np.ptp(model.jnt_range[joint]) < _RAIL
        if (kind == free or endless) and np.ptp(positions[:, body], axis=0).max() >= _SHORTEST_PATH:
            return body
    return None


def _describe_shape(model: mujoco.MjModel, geom: int, links: list[str]) -> Shape | None:
    """Describe a geom; None where it is transparent."""
    import mujoco

    size, color, material = model.geom_size[geom].tolist(), model.geom_rgba[geom].tolist(), model.geom_matid[geom]
    if material >= 0 and color == _NO_COLOR:
        color = model.mat_rgba[material].tolist()
    if color[3] == 0:
        return None
    kinds = mujoco.mjtGeom
    known: dict[int, tuple[ShapeKind, tuple[float, ...]]] = {
        int(kinds.mjGEOM_SPHERE): (ShapeKind.SPHERE, (size[0],)),
        int(kinds.mjGEOM_ELLIPSOID): (ShapeKind.SPHERE, tuple(size)),
        int(kinds.mjGEOM_BOX): (ShapeKind.BOX, tuple(2 * half for half in size)),
        int(kinds.mjGEOM_CAPSULE): (ShapeKind.CAPSULE, (2 * size[1], size[0])),
        int(kinds.mjGEOM_CYLINDER): (ShapeKind.CYLINDER, (2 * size[1], size[0])),
        int(kinds.mjGEOM_PLANE): (ShapeKind.BOX, (2 * (size[0] or 2.0), 2 * (size[1] or 2.0), 0.002)),
        int(kinds.mjGEOM_MESH): (ShapeKind.MESH, (1.0, 1.0, 1.0)),
    }
    kind, extents = known.get(int(model.geom_type[geom]), (ShapeKind.OTHER, ()))
    mesh = _read_mesh(model, int(model.geom_dataid[geom])) if kind is ShapeKind.MESH else None
    position, orientation = model.geom_pos[geom].tolist(), model.geom_quat[geom][_XYZW].tolist()
    link = links[model.geom_bodyid[geom]]
    return Shape(link, kind, extents, mesh, tuple(position), tuple(orientation), tuple(color))


def _read_mesh(model: mujoco.MjModel, mesh: int) -> Mesh:
    def part(name: str, values: NDArray[Any]) -> NDArray[Any]:
        start = getattr(model, f"mesh_{name}adr")[mesh]
        return values[start : start + getattr(model, f"mesh_{name}num")[mesh]]

    return Mesh(part("vert", model.mesh_vert), part("face", model.mesh_face))
