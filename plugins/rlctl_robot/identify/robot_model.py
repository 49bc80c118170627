"""A robot of a model file, on a stand: each joint has a position servo whose values are unknown."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.errors import TaskError, UsageError, check_name
from rlctl.task.model_files import explain_missing, find_model_file
from rlctl.task.mujoco.files import ModelFile, read_model_file
from rlctl.task.mujoco.real_motors import insert_play, set_friction_impedance
from rlctl.task.mujoco.world import import_mujoco
from rlctl_robot.identify.log import Array

STIFFNESS, DAMPING = "stiffness_nm_per_rad", "damping_nms_per_rad"
ARMATURE, COULOMB, VISCOUS = "armature_kgm2", "coulomb_friction_nm", "viscous_friction_nms_per_rad"
BIAS, BACKLASH, DELAY, MASS = "encoder_bias_rad", "backlash_rad", "delay_s", "mass_factor"
TORQUE = "max_torque_nm"
OF_JOINTS = (STIFFNESS, ARMATURE, VISCOUS, COULOMB, BIAS, TORQUE, BACKLASH)
"""Values of each joint, with the names of `rlctl.task.motors.Motor`."""
_SHORTEST_STEP, _LONGEST_STEP = 0.0005, 0.005  # [s], of the physics
UNLIMITED = 1e9  # [N m or N]
_USUAL_STEP = 0.004  # of tasks with a URDF, which has none
_LEAST_MASS = 0.01  # of the heaviest link, of a link whose mass can be estimated

Values = dict[str, Array]
"""Values by quantity: (joints,) each; `delay_s` is (), `mass_factor` (bodies,). Stacked ones have a leading axis."""


@dataclasses.dataclass(frozen=True, eq=False)
class RobotModel:
    """A compiled robot whose base is fixed, whose shapes touch nothing, and whose joints all have a servo."""

    path: Path
    joints: tuple[str, ...]
    model: Any
    """`mujoco.MjModel`: `nq`, `nv` and `nu` are the number of joints; with play a joint more for each."""
    places: Array  # numbers of the joints in `qpos` and `qvel`
    play_places: Array  # of the joints that are their play; none without play
    trees: Array  # number of the kinematic tree of each joint: joints of two trees do not move each other
    low: Array  # [rad or m], shape (joints,); -inf and inf without limits
    high: Array
    max_speed: Array  # [rad/s or m/s]; 0 where the file has none
    nominal: Values  # of the file; the stiffness is NaN where it has no position servo
    links: tuple[str, ...]  # of the bodies whose mass can be estimated
    link_numbers: tuple[int, ...]  # their numbers in the model
    is_turning: tuple[bool, ...]  # whether a joint is a hinge
    notes: tuple[str, ...] = ()


def is_model_file(name: str) -> bool:
    """Return whether a name on the command line is that of a model file, not of a task."""
    return name.endswith((".xml", ".urdf", ".xacro"))


def find_robot(file: str | Path) -> Path:
    """Return the path of a model file that the command line names; raises `UsageError` if there is none."""
    try:
        return find_model_file(file)
    except TaskError:
        raise UsageError(explain_missing(Path(file))) from None


def list_servo_joints(path: Path) -> tuple[str, ...]:
    """Return the joints of a model file that a log may contain: those with actuators, or all if it has none."""
    spec = read_model_file(path, fixed=True, visuals=False).spec
    kinds = import_mujoco().mjtJoint
    single = (int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE))
    driven = [actuator.target for actuator in spec.actuators]
    model = _compile(path, spec)
    names = [model.joint(number).name for number in range(model.njnt) if int(model.jnt_type[number]) in single]
    if not names:
        raise UsageError(f"{path}: it has no joints that turn or slide")
    return tuple(name for name in names if name in driven) or tuple(names)


def _compile(path: Path, spec: Any) -> Any:
    try:
        return spec.compile()
    except ValueError as error:
        raise TaskError(f"MuJoCo cannot load {path}: {' '.join(str(error).split())}") from None


def read_robot(
    file: str | Path,
    joints: Sequence[str] = (),
    *,
    timestep: float | None = None,
    collides: bool = False,
    plays: bool = False,
) -> RobotModel:
    """Read a robot with a servo at each of `joints` (default: all that have one); the others are locked.

    Its base is fixed where the file has it. With `plays` the gears have play, whose size `backlash_rad` is, between the
    servo with its encoder and the link. The physics step is `timestep` [s], or the file's. Raises `TaskError` for a
    file that cannot be read, `UsageError` for a joint that is not there.
    """
    path = find_robot(file)
    source = read_model_file(path, fixed=True, visuals=False)
    spec, mujoco = source.spec, import_mujoco()
    possible = list_servo_joints(path)
    for joint in joints:
        check_name(joint, possible, f"{path}: no joint", UsageError)
    kept = [joint for joint in possible if joint in (joints or possible)]  # in MuJoCo's order
    servos = {name: _find_servo(spec, name) for name in kept}
    notes = _simplify(spec, kept, path)
    if not collides:
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    if path.suffix == ".urdf":
        spec.option.timestep = _USUAL_STEP
    spec.option.timestep = float(np.clip(timestep or spec.option.timestep, _SHORTEST_STEP, _LONGEST_STEP))
    for name in kept:
        _add_servo(spec, name, servos[name], source)
    if plays:
        for name in kept:
            insert_play(mujoco, spec.joint(name), f"play of {name}", spec.option.timestep)
    model = _compile(path, spec)
    return _describe(path, model, kept, servos, source, notes)


def _find_servo(spec: Any, joint: str) -> tuple[float, float, float]:
    """Return stiffness, damping and largest torque of a joint's position servo in a file: NaN, 0 and 0 if unknown."""
    affine = import_mujoco().mjtBias.mjBIAS_AFFINE
    for actuator in spec.actuators:
        if actuator.target != joint:
            continue
        gear = abs(float(actuator.gear[0]))
        force = 0.0
        if np.any(actuator.forcerange):
            force = gear * float(np.max(np.abs(actuator.forcerange)))
        is_position = actuator.biastype == affine and actuator.biasprm[1] < 0
        if is_position:
            return -gear * gear * actuator.biasprm[1], -gear * gear * actuator.biasprm[2], force
        return np.nan, 0.0, force
    return np.nan, 0.0, 0.0


def _simplify(spec: Any, kept: Sequence[str], path: Path) -> list[str]:
    """Delete what a log of joints does not contain: other joints, tendons, sensors, keyframes and loops."""
    notes = []
    locked = [joint for joint in spec.joints if joint.name not in kept]
    free = import_mujoco().mjtJoint.mjJNT_FREE
    if names := [joint.name for joint in locked if joint.type != free]:
        notes.append(f"{path}: not in the log, so locked: {', '.join(names)}")
    if spec.equalities:
        notes.append(f"{path}: its constraints between joints or links are left out")
    parts = [spec.keys, spec.sensors, spec.actuators, spec.tendons, spec.equalities, locked]
    for part in parts:
        for element in list(part):
            spec.delete(element)
    return notes


def _add_servo(spec: Any, name: str, servo: tuple[float, float, float], source: ModelFile) -> None:
    mujoco = import_mujoco()
    stiffness, damping, force = servo
    joint = spec.joint(name)
    force = force or source.max_force.get(name, 0.0)
    joint.actfrclimited = False  # the limits are those of the servos
    motor = spec.add_actuator(name=f"servo {name}", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    gain = 1.0 if np.isnan(stiffness) else stiffness
    motor.gainprm[0], motor.biasprm[1], motor.biasprm[2] = gain, -gain, -damping
    force = force or UNLIMITED
    motor.forcelimited, motor.forcerange = True, [-force, force]
    # Where a value is 0, MuJoCo leaves out what belongs to it, and worlds of a batch could not change it.
    joint.frictionloss = max(joint.frictionloss, 1e-6)
    joint.armature = max(joint.armature, 1e-6)
    set_friction_impedance(joint, spec.option.timestep)


def _describe(
    path: Path,
    model: Any,
    kept: Sequence[str],
    servos: dict[str, tuple[float, float, float]],
    source: ModelFile,
    notes: Sequence[str],
) -> RobotModel:
    places = np.array([int(model.joint(name).qposadr[0]) for name in kept])
    limited = model.jnt_limited[places].astype(bool)
    low, high = np.where(limited, model.jnt_range[places].T, [[-np.inf], [np.inf]])
    heavy = model.body_mass > _LEAST_MASS * model.body_mass.max()
    moving = [number for number in range(1, model.nbody) if model.body_weldid[number] and heavy[number]]
    nominal = {
        STIFFNESS: np.array([servos[name][0] for name in kept]),
        DAMPING: np.array([servos[name][1] for name in kept]),
        ARMATURE: model.dof_armature[places],
        VISCOUS: model.dof_damping[places],
        COULOMB: model.dof_frictionloss[places],
        BIAS: np.zeros(len(kept)),
        TORQUE: model.actuator_forcerange[:, 1].copy(),
        BACKLASH: np.zeros(len(kept)),
        DELAY: np.array(0.0),
        MASS: np.ones(model.nbody),
    }
    return RobotModel(
        path=path,
        joints=tuple(kept),
        model=model,
        places=places,
        play_places=np.setdiff1d(np.arange(model.nv), places),
        trees=np.array(model.dof_treeid)[places],
        low=low,
        high=high,
        max_speed=np.array([source.max_speed.get(name, 0.0) for name in kept]),
        nominal=nominal,
        links=tuple(model.body(number).name for number in moving),
        link_numbers=tuple(moving),
        is_turning=tuple(int(kind) == int(import_mujoco().mjtJoint.mjJNT_HINGE) for kind in model.jnt_type[places]),
        notes=tuple(notes),
    )


def stack_values(values: Values, count: int) -> Values:
    """Return `count` copies of values, stacked."""
    return {name: np.repeat(np.asarray(value)[None], count, axis=0) for name, value in values.items()}
