"""What `rlctl identify ROBOT` prints and writes: a table, a model file, and values for `set_motors`."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rlctl import output
from rlctl.storage import files
from rlctl.task.mujoco.files import read_model_file
from rlctl.task.mujoco.real_motors import set_friction_impedance
from rlctl.task.mujoco.world import import_mujoco
from rlctl_robot.identify.robot import RobotIdentification, RobotValue, describe
from rlctl_robot.identify.robot_model import (
    ARMATURE,
    BACKLASH,
    BIAS,
    COULOMB,
    DAMPING,
    DELAY,
    MASS,
    OF_JOINTS,
    STIFFNESS,
    TORQUE,
    VISCOUS,
)

_TITLES = {
    STIFFNESS: "stiffness [N m/rad]",
    ARMATURE: "armature [kg m^2]",
    VISCOUS: "viscous [N m s/rad]",
    COULOMB: "Coulomb [N m]",
    BIAS: "bias [rad]",
    TORQUE: "largest torque [N m]",
    BACKLASH: "backlash [rad]",
    MASS: "mass [factor]",
}
_EVENTS = (
    (COULOMB, "motor_friction", "coulomb_nm"),
    (BIAS, "motor_bias", "bias_rad"),
    (BACKLASH, "backlash", "backlash_rad"),
    (DELAY, "motor_delay", "delay_s"),
)
"""Quantities, the events that change them, and their parameters."""
_UNKNOWN = "cannot tell"
_MIN_WIDTH = 0.02
"""Smallest half width of a range for training, relative to the value: intervals leave out the model's errors."""


def show_robot(result: RobotIdentification, written: list[Path], json: str | None) -> None:
    """Print the values with their intervals, or write them as JSON to a file or, for `-`, to stdout."""
    parts = {"motors": make_motors(result), "ranges": make_ranges(result), "events": make_events(result)}
    if output.present({**describe(result), **parts}, json):
        return
    out = output.out()
    out.print(f"{result.robot}: {result.log}, {result.rows:,} rows, {result.seconds:.1f} s")
    for rows, quantities, title in (
        (list(result.joints), OF_JOINTS, "joint"),
        (sorted({value.part for value in result.values if value.quantity == MASS}), (MASS,), "link"),
    ):
        shown = [quantity for quantity in quantities if any(value.quantity == quantity for value in result.values)]
        if shown and rows:
            cells = [(part, *(_format(result.find(part, quantity)) for quantity in shown)) for part in rows]
            output.print_table((title, *(_TITLES[quantity] for quantity in shown)), cells, left=(title,))
    delay = result.find("", DELAY)
    if delay is not None:
        text = f"{_format(delay)} s" if delay.known else _UNKNOWN
        out.print(f"delay from command to torque: {text}")
    out.print(
        f"error of positions in {result.held_out_seconds:.1f} s held out of the fit: {result.error_before:.3g} rad "
        f"with the file's values, {result.error_after:.3g} rad with these (m if sliding)"
    )
    for note in _list_notes(result):
        out.print(note)
    if written:
        out.print(f"written: {', '.join(str(path) for path in written)}")
    else:
        out.print("\nto write them as a model file and for set_motors: -o FOLDER")


def _list_notes(result: RobotIdentification) -> list[str]:
    """Return why values are not known, a line for all values of a joint with the same reason."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for value in result.values:
        if value.note:
            reasons.setdefault((value.part, value.note), []).append(value.quantity)
    return [f"{part} {', '.join(names)}: {note}".strip() for (part, note), names in reasons.items()]


def _format(value: RobotValue | None) -> str:
    """Return a value with the half width of its interval."""
    if value is None:
        return ""
    if not value.known:
        return _UNKNOWN
    half = max(value.high - value.value, value.value - value.low)
    return f"{value.value:.3g} ± {half:.2g}"


def make_motors(result: RobotIdentification) -> dict[str, dict[str, float]]:
    """Return values by joint, with the names of `rlctl.task.motors.Motor`.

    A value that the log cannot tell is the one of the fit, so that all of them together move as the robot does; where
    the joint does not move, it is left out.
    """
    motors: dict[str, dict[str, float]] = {}
    for joint, name in enumerate(result.joints):
        chosen = [value for value in result.values if value.part == name and value.quantity != MASS]
        motor = {value.quantity: _round(value.value) for value in chosen if math.isfinite(value.value)}
        if not motor:
            continue
        for quantity in (STIFFNESS, DAMPING, ARMATURE, VISCOUS, COULOMB):
            motor.setdefault(quantity, _round(float(result.fitted[quantity][joint])))
        motor[DELAY] = _round(float(result.fitted[DELAY]))
        motors[name] = motor
    return motors


def make_ranges(result: RobotIdentification) -> dict[str, dict[str, list[float]]]:
    """Return the intervals of the known values by joint or link, at least 2 % to each side; the delay's under `all`."""
    ranges: dict[str, dict[str, list[float]]] = {}
    for value in result.values:
        if value.known:
            least = _MIN_WIDTH * abs(value.value)
            low, high = min(value.low, value.value - least), max(value.high, value.value + least)
            ranges.setdefault(value.part or "all", {})[value.quantity] = [_round(low), _round(high)]
    return ranges


def make_events(result: RobotIdentification) -> dict[str, dict[str, list[float]]]:
    """Return ranges of the events of motors (`rlctl.task.events`), which hold for all joints whose value is known."""
    ranges = list(make_ranges(result).values())
    events: dict[str, dict[str, list[float]]] = {}
    for quantity, event, key in _EVENTS:
        intervals = [interval for part in ranges for name, interval in part.items() if name == quantity]
        if intervals:
            lowest, highest = np.array(intervals).min(axis=0)[0], np.array(intervals).max(axis=0)[1]
            events[event] = {key: [_round(float(lowest)), _round(float(highest))]}
    factors = [
        (value.low / value.value, value.high / value.value)
        for value in result.values
        if value.known and value.quantity == STIFFNESS
    ]
    if factors:
        low, high = min(low for low, _ in factors), max(high for _, high in factors)
        events["torque_constant"] = {"factor": [_round(min(low, 1 - _MIN_WIDTH)), _round(max(high, 1 + _MIN_WIDTH))]}
    return events


def write_robot(result: RobotIdentification, folder: Path) -> list[Path]:
    """Write the robot as MJCF with the values found, and `NAME.motors.yaml` for `set_motors`; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    model = folder / f"{result.robot.stem}.identified.xml"
    motors = folder / f"{result.robot.stem}.motors.yaml"
    files.write_text(model, make_mjcf(result))
    content = {"motors": make_motors(result), "ranges": make_ranges(result), "events": make_events(result)}
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
    files.write_text(motors, f"# rlctl identify {result.robot.name} --log {result.log.name}\n{text}")
    return [model, motors]


def make_mjcf(result: RobotIdentification) -> str:
    """Return the robot as MJCF, with the armature, friction and position servos that were found."""
    mujoco = import_mujoco()
    if result.robot.suffix == ".urdf":
        spec = read_model_file(result.robot, fixed=True, hulls=False).spec
    else:
        spec = mujoco.MjSpec.from_file(str(result.robot))
    spec.meshdir = str((result.robot.parent / spec.meshdir).resolve())
    spec.texturedir = str((result.robot.parent / spec.texturedir).resolve())
    for name, motor in make_motors(result).items():
        joint = spec.joint(name)
        joint.armature, joint.frictionloss = motor[ARMATURE], motor[COULOMB]
        joint.damping = [motor[VISCOUS], 0.0, 0.0]
        set_friction_impedance(joint, spec.option.timestep)
        _set_servo(spec, name, motor)
        if TORQUE in motor:
            spec.joint(name).actfrcrange = [-motor[TORQUE], motor[TORQUE]]
            spec.joint(name).actfrclimited = True
    for value in result.values:
        if value.quantity == MASS and value.known:
            body = spec.body(value.part)
            body.mass, body.inertia = body.mass * value.value, np.array(body.inertia) * value.value
            body.fullinertia = np.array(body.fullinertia) * value.value
    text: str = spec.to_xml()
    return text


def _set_servo(spec: Any, joint: str, motor: dict[str, float]) -> None:
    mujoco = import_mujoco()
    mine = [actuator for actuator in spec.actuators if actuator.target == joint]
    servo = mine[0] if mine else spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    gear = float(servo.gear[0])
    servo.gaintype, servo.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    stiffness, damping = motor[STIFFNESS] / gear**2, motor[DAMPING] / gear**2
    servo.gainprm[0], servo.biasprm[1], servo.biasprm[2] = stiffness, -stiffness, -damping


def _round(value: float) -> float:
    return float(f"{value:.5g}")
