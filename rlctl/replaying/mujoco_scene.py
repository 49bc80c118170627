"""The scene of an episode in a MuJoCo environment: the geoms of its model, moved by its state."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.driven_joints import joint_name
from rlctl.environments.simulations import find_mujoco
from rlctl.replaying.mjcf import Mesh, Shape, ShapeKind
from rlctl.replaying.scene import BodyMotion, Env, Scene
from rlctl.task.env import TaskEnv

if TYPE_CHECKING:
    import mujoco

    from rlctl.task.body import Body
    from rlctl.task.mujoco.sim import MujocoSim

Array = NDArray[np.float64]

_VISIBLE_GROUPS = 3  # of geoms: those that MuJoCo's viewer shows; the others are for collisions
_GROUND_SIZE = 8.0  # [m]
_RAIL = 100.0  # [m]; a sliding joint that is longer has no limits
_SHORTEST_PATH = 0.3  # [m]; a body that moves less is not a trunk
_NO_COLOR = [0.5, 0.5, 0.5, 1.0]  # of a geom that has a material, or none
_XYZW = [1, 2, 3, 0]


class MujocoReader:
    """Reads the poses of all bodies after every step, without changing the simulation."""

    def __init__(self, env: Env) -> None:
        self._env = env

    def read(self, step: int) -> None:
        """Read the world after a step; 0 is the reset."""
        import mujoco

        model, data = find_mujoco(self._env)  # type: ignore[misc]
        if step == 0:  # only now: a reset may load the model again
            self._model, self._scratch = model, mujoco.MjData(model)
            self._rows: list[list[Array]] = []
            self._markers: dict[str, list[Array]] = {}
        scratch = self._scratch
        # After a step `xpos` is where bodies were before its last substep.
        scratch.qpos[:], scratch.mocap_pos[:], scratch.mocap_quat[:] = data.qpos, data.mocap_pos, data.mocap_quat
        mujoco.mj_kinematics(model, scratch)
        parts = (scratch.xpos, scratch.xquat, scratch.geom_xpos, scratch.site_xpos, data.qpos, data.qvel)
        self._rows.append([part.copy() for part in parts])
        inner = self._env.unwrapped
        if isinstance(inner, TaskEnv):
            markers = inner.markers()
        else:
            goal = getattr(inner, "goal", None)
            markers = {"goal": goal} if isinstance(goal, np.ndarray) and goal.shape == (3,) else {}
        for name, position in markers.items():
            self._markers.setdefault(name, []).append(np.array(position, np.float64))

    def scene(self) -> Scene:
        """Return what was read since the last reset."""
        model = self._model
        positions, turns, centers, sites, qpos, qvel = (np.stack(part) for part in zip(*self._rows, strict=True))
        grounds = _find_ground(model)
        visible = np.flatnonzero(model.geom_group < _VISIBLE_GROUPS).tolist()
        shown = [geom for geom in visible if geom not in grounds]
        links = [model.body(body).name or f"body {body}" for body in range(model.nbody)]
        joints = [joint for joint in range(model.njnt) if model.jnt_type[joint] >= _enum("mjtJoint", "mjJNT_SLIDE")]
        trunk = _find_trunk(model, positions)
        robot = BodyMotion(
            name="robot",
            file=Path("MuJoCo model"),
            joint_names=[joint_name(model, joint) for joint in joints],
            joint_positions=qpos[:, model.jnt_qposadr[joints]],
            joint_velocities=qvel[:, model.jnt_dofadr[joints]],
            links=links,
            positions=positions,
            orientations=turns[:, :, _XYZW],
            shapes=[shape for geom in shown if (shape := _describe_shape(model, geom, links)) is not None],
            trunk=trunk,
            box=_find_box(model, [geom for geom in shown if trunk is None or model.geom_bodyid[geom]], centers[0]),
        )
        names = {model.site(site).name: site for site in range(model.nsite)}
        goals = {name: sites[:, site] for name, site in names.items() if "goal" in name or "target" in name}
        complete = {name: np.stack(rows) for name, rows in self._markers.items() if len(rows) == len(positions)}
        return Scene([*(_describe_ground(model, geom, centers[0]) for geom in grounds), robot], complete or goals)


def _enum(kind: str, name: str) -> int:
    import mujoco

    return int(getattr(getattr(mujoco, kind), name))  # MuJoCo 4's enums compare with integers only after conversion


def _find_ground(model: mujoco.MjModel) -> list[int]:
    plane, box = (model.geom_type == _enum("mjtGeom", name) for name in ("mjGEOM_PLANE", "mjGEOM_BOX"))
    wide = box & (model.geom_size[:, :2].min(axis=1) > _GROUND_SIZE / 2)  # what PyBullet's plane.urdf is
    fixed = (model.body_weldid[model.geom_bodyid] == 0) & (model.geom_group < _VISIBLE_GROUPS)
    return [int(geom) for geom in np.flatnonzero((plane | wide) & fixed)]


def _describe_ground(model: mujoco.MjModel, geom: int, centers: Array) -> BodyMotion:
    name = model.geom(geom).name or f"plane {geom}"
    thickness = model.geom_size[geom, 2] if model.geom_type[geom] == _enum("mjtGeom", "mjGEOM_BOX") else 0.0
    return BodyMotion(name=name, file=Path(name), ground_height=float(centers[geom, 2] + thickness))


def _find_box(model: mujoco.MjModel, geoms: list[int], centers: Array) -> tuple[Array, Array]:
    radii, middle = model.geom_rbound[geoms, None], centers[geoms]
    return ((middle - radii).min(axis=0), (middle + radii).max(axis=0)) if geoms else (-np.ones(3), np.ones(3))


def find_trunk_joint(model: mujoco.MjModel, joint: int) -> Literal["free", "rail"] | None:
    """Return `free` for a free joint, `rail` for a sliding joint without limits, and None for any other."""
    kind = int(model.jnt_type[joint])
    if kind == _enum("mjtJoint", "mjJNT_FREE"):
        return "free"
    endless = kind == _enum("mjtJoint", "mjJNT_SLIDE") and not 0 < np.ptp(model.jnt_range[joint]) < _RAIL
    return "rail" if endless else None


def find_missing_floor(sim: MujocoSim) -> float | None:
    """Return the height of the lowest point [m] where a floor is drawn; None where a world has a ground."""
    sim.world.refresh()
    model, heights = sim.model, sim.data.geom_xpos[:, 2]
    is_terrain = (model.geom_type == _enum("mjtGeom", "mjGEOM_HFIELD")).any()
    if is_terrain or _find_ground(model) or model.ngeom == 0:
        return None
    turns = sim.data.geom_xmat.reshape(-1, 3, 3)[:, 2]
    centers = heights + (turns * model.geom_aabb[:, :3]).sum(axis=1)
    halves = (np.abs(turns) * model.geom_aabb[:, 3:]).sum(axis=1)
    return float((centers - halves).min())


def find_mujoco_bounds(sim: MujocoSim, bodies: Sequence[Body], markers: Sequence[Array]) -> tuple[Array, Array]:
    """Return the lowest and highest corner [m] of markers and of the links that are not fixed to the world."""
    sim.world.refresh()
    parts = [sim.bodies[body.name].parts for body in bodies]
    wanted = {number for part in parts for link, number in part.links.items() if link in part.moving}
    geoms = [
        geom
        for geom in range(sim.model.ngeom)
        if int(sim.model.geom_bodyid[geom]) in wanted and 0 < sim.model.geom_rbound[geom] < _GROUND_SIZE / 2
    ]
    turns = sim.data.geom_xmat[geoms].reshape(-1, 3, 3)
    boxes = sim.model.geom_aabb[geoms]  # centre and half sides in the frame of the geom
    centers = sim.data.geom_xpos[geoms] + np.einsum("gij,gj->gi", turns, boxes[:, :3])
    halves = np.einsum("gij,gj->gi", np.abs(turns), boxes[:, 3:])
    corners = [*markers, *(centers - halves), *(centers + halves)]
    return (np.min(corners, axis=0), np.max(corners, axis=0)) if corners else (-np.ones(3), np.ones(3))


def _find_trunk(model: mujoco.MjModel, positions: Array) -> int | None:
    """Return the first body that travels on a free joint, or on a sliding joint without limits."""
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        travels = np.ptp(positions[:, body], axis=0).max() >= _SHORTEST_PATH
        if travels and find_trunk_joint(model, joint) is not None:
            return body
    return None


def _describe_shape(model: mujoco.MjModel, geom: int, links: list[str]) -> Shape | None:
    """Return a geom as a shape, or None if it is transparent."""
    size, color, material = model.geom_size[geom].tolist(), model.geom_rgba[geom].tolist(), model.geom_matid[geom]
    if material >= 0 and color == _NO_COLOR:
        color = model.mat_rgba[material].tolist()
    if color[3] == 0:
        return None
    known: dict[str, tuple[ShapeKind, tuple[float, ...]]] = {
        "SPHERE": (ShapeKind.SPHERE, (size[0],)),
        "ELLIPSOID": (ShapeKind.SPHERE, tuple(size)),
        "BOX": (ShapeKind.BOX, tuple(2 * half for half in size)),
        "CAPSULE": (ShapeKind.CAPSULE, (2 * size[1], size[0])),
        "CYLINDER": (ShapeKind.CYLINDER, (2 * size[1], size[0])),
        "PLANE": (ShapeKind.BOX, (2 * (size[0] or 2.0), 2 * (size[1] or 2.0), 0.002)),
        "MESH": (ShapeKind.MESH, (1.0, 1.0, 1.0)),
    }
    numbers = {_enum("mjtGeom", f"mjGEOM_{name}"): name for name in known}
    kind, extents = known.get(numbers.get(int(model.geom_type[geom]), ""), (ShapeKind.OTHER, ()))
    mesh = _read_mesh(model, int(model.geom_dataid[geom])) if kind is ShapeKind.MESH else None
    position, orientation = model.geom_pos[geom].tolist(), model.geom_quat[geom][_XYZW].tolist()
    link = links[model.geom_bodyid[geom]]
    return Shape(link, kind, extents, mesh, tuple(position), tuple(orientation), tuple(color))


def _read_mesh(model: mujoco.MjModel, mesh: int) -> Mesh:
    def part(name: str, values: NDArray[Any]) -> NDArray[Any]:
        start = getattr(model, f"mesh_{name}adr")[mesh]
        return values[start : start + getattr(model, f"mesh_{name}num")[mesh]]

    return Mesh(part("vert", model.mesh_vert), part("face", model.mesh_face))
