"""The robot model of an imported policy: names, limits and poses of its file, and the height at which it stands."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rlctl.errors import TaskError, UsageError

if TYPE_CHECKING:
    from rlctl.task.mujoco.body import MujocoBody

_HIGH = 5.0  # [m], where the robot is placed to measure how far its feet are below its trunk
_CLEARANCE = 0.005  # [m], between feet and ground at the start
_CONTROL_DT = 0.02  # [s]


@dataclasses.dataclass(frozen=True)
class Robot:
    """What a robot model says of its joints."""

    path: Path
    joints: tuple[str, ...]  # in the order of the file
    motors: tuple[str, ...]  # joints in the order of the file's actuators; empty if not all have one
    breadth_first: tuple[str, ...]  # joints by their distance from the base, as Isaac Lab orders them
    limits: Mapping[str, float]  # torque by joint [N m]; 0: none
    ranges: Mapping[str, tuple[float, float]]  # lowest and highest position by joint [rad]
    links: tuple[str, ...]  # the base is the first
    has_armature: bool
    sensors: tuple[str, ...] = ()  # of an MJCF file
    keyframe: str = ""  # name of the file's keyframe `home`, or of its first
    pose: Mapping[str, float] = dataclasses.field(default_factory=dict)  # [rad], of the keyframe
    gains: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Stiffness [N m/rad] and damping [N m s/rad] by joint, of the file's position actuators."""

    def measure_start(
        self, positions: Mapping[str, float], orientation: Sequence[float] = (0.0, 0.0, 0.0, 1.0)
    ) -> float:
        """Return the height of the trunk's centre of mass [m] at which the feet are just above flat ground."""
        from rlctl.task.mujoco.sim import MujocoSim

        sim = MujocoSim(control_dt=_CONTROL_DT, substeps=4)
        ground = sim.load("ground", "plane.urdf", fixed=True)
        body = sim.load("robot", self.path, floor=False)
        sim.save()
        body.set_base((0.0, 0.0, _HIGH), orientation)
        body.set_joints(np.array([positions.get(name, 0.0) for name in body.joint_names]))
        distance = body.distance_to(ground)
        if not np.isfinite(distance):
            raise UsageError(f"--model {self.path}: it has no collision shapes, so it cannot stand")
        return float(_HIGH - distance + _CLEARANCE)


def read_robot(path: Path) -> Robot:
    """Read a robot model with a free base; raises `UsageError` for any other."""
    from rlctl.task.mujoco.sim import MujocoSim

    try:
        body = MujocoSim(control_dt=_CONTROL_DT, substeps=4).load("robot", path, floor=False)
    except TaskError as error:
        raise UsageError(f"--model: {error}") from None
    if not body.joint_names:
        raise UsageError(f"--model {path}: it has no joints")
    if body.fixed:
        raise UsageError(f"--model {path}: its base is fixed; add <freejoint/> to the body {body.base_name!r}")
    armature = body._sim.model.dof_armature[body.parts.velocities]
    keyframe, pose = read_keyframe(path, body.joint_names)
    return Robot(
        path=path.resolve(),
        joints=tuple(body.joint_names),
        motors=_list_motors(path, body.joint_names),
        breadth_first=_sort_by_depth(body),
        limits=dict(zip(body.joint_names, body.joint_max_force.tolist(), strict=True)),
        ranges={
            name: (float(low), float(high))
            for name, low, high in zip(body.joint_names, body.joint_low, body.joint_high, strict=True)
        },
        links=(body.base_name, *body.link_names),
        has_armature=bool(armature.any()),
        sensors=tuple(body.sensor_names),
        keyframe=keyframe,
        pose=pose,
        gains=_read_gains(path),
    )


def _read_gains(path: Path) -> dict[str, tuple[float, float]]:
    """Return the gains of the actuators of an MJCF file that drive joints to positions."""
    if path.suffix != ".xml":
        return {}
    import mujoco

    spec = mujoco.MjSpec.from_file(str(path))
    gains: dict[str, tuple[float, float]] = {}
    for actuator in spec.actuators:
        stiffness, damping = float(actuator.gainprm[0]), -float(actuator.biasprm[2])
        if int(actuator.biastype) == int(mujoco.mjtBias.mjBIAS_AFFINE) and actuator.biasprm[1] == -stiffness:
            gains[str(actuator.target)] = stiffness, max(damping, 0.0)
    return gains


def _sort_by_depth(body: MujocoBody) -> tuple[str, ...]:
    model = body._sim.model
    depths: dict[str, int] = {}
    for name, joint in zip(body.joint_names, body.parts.joints, strict=True):
        link, depth = int(model.jnt_bodyid[joint]), 0
        while link:
            link, depth = int(model.body_parentid[link]), depth + int(model.body_jntnum[link] > 0)
        depths[name] = depth
    return tuple(sorted(body.joint_names, key=lambda name: depths[name]))


def _list_motors(path: Path, joints: Sequence[str]) -> tuple[str, ...]:
    if path.suffix != ".xml":
        return ()
    import mujoco

    spec = mujoco.MjSpec.from_file(str(path))
    moved = tuple(str(actuator.target) for actuator in spec.actuators)
    return moved if sorted(moved) == sorted(joints) else ()


def read_keyframe(path: Path, joints: Sequence[str]) -> tuple[str, dict[str, float]]:
    """Return name and joint positions of the keyframe `home` of an MJCF file, or of its first; empty without one."""
    if path.suffix != ".xml":
        return "", {}
    import mujoco

    spec = mujoco.MjSpec.from_file(str(path))
    keys = sorted(spec.keys, key=lambda key: str(key.name) != "home")  # the order of the others stays
    sizes = {0: 7, 1: 4}  # free and ball joints
    starts = np.cumsum([0, *(sizes.get(int(joint.type), 1) for joint in spec.joints)]).tolist()
    if not keys or len(keys[0].qpos) != starts[-1]:
        return "", {}
    places = {str(joint.name): start for start, joint in zip(starts, spec.joints, strict=False)}
    pose = {name: float(keys[0].qpos[places[name]]) for name in joints if name in places}
    return str(keys[0].name) or "0", pose
