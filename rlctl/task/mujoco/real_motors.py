"""Real motors in MuJoCo: its DC motors with a controller on board, dry friction, and play as a joint in series.

The control of such an actuator is a torque that is added to that of its controller, so `stiffness * target` makes it a
position controller, as the control of the springs in `motors.py` does. Only a controller with an integral has the
target itself as its control. MuJoCo computes voltage, current and back-EMF in every physics step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError
from rlctl.task.motors import Motor

Array = NDArray[np.float64]

# Elements of `actuator_gainprm` of a DC motor.
RESISTANCE, CONSTANT, STIFFNESS, INTEGRAL, DAMPING, VOLTAGE = 0, 1, 4, 5, 6, 7
_FRICTION = (0.999, 0.999, 0.001, 0.5, 2)  # impedance: a held joint creeps by 1e-4 rad/s, by 1e-2 with MuJoCo's default
_STOP = (0.99, 0.999, 0.001, 0.5, 2)  # of the ends of the play
_ITERATIONS = 20
"""Of the solver, at least, for joints with play: a quadruped's explode with 5, and stand with 8."""
_ROOM = 2  # times the delay, for events that make it longer
_HISTORY_HEADER = 2  # numbers before the time stamps of a history of controls


def name_play(body: str, joint: str) -> str:
    """Return the name of the joint in series that is a joint's play."""
    return f"{body}/play of {joint}"


def add_motors(mujoco: Any, spec: Any, body: str, motors: Mapping[str, Motor]) -> None:
    """Make actuators of a body's joints DC motors, and add their play, in the `MjSpec` of a world."""
    timestep = spec.option.timestep
    for name, motor in motors.items():
        joint = spec.joint(f"{body}/{name}")
        set_friction_impedance(joint, timestep)
        if motor.armature_kgm2 is not None:
            joint.armature = motor.armature_kgm2  # before the compilation, which scales the stops of the play by it
        if motor.backlash_rad > 0:
            spec.option.iterations = max(spec.option.iterations, _ITERATIONS)
            _add_play(mujoco, spec, body, name, timestep)
        actuator = spec.actuator(f"{body}/motor {name}")
        inputs, largest = mujoco.mjtCtrlInput.mjINPUT_FF, 0.0
        if motor.integral_nm_per_rads > 0:
            inputs = mujoco.mjtCtrlInput.mjINPUT_POS
            largest = (motor.stall_torque_nm or 0.0) / motor.integral_nm_per_rads  # 0: the integral has no limit
        constant, resistance, voltage = read_electric(motor)
        actuator.set_to_dcmotor(
            motorconst=[constant, 0.0],
            resistance=resistance,
            controller=[motor.stiffness_nm_per_rad or 0.0, motor.integral_nm_per_rads, 0.0, 0.0, largest, voltage],
            ctrlspec=int(inputs),
        )
        actuator.forcelimited = True
        samples = count_samples(motor.delay_s, timestep)
        if samples:
            actuator.nsample, actuator.delay = _ROOM * samples, delay_of(samples, timestep)


def _add_play(mujoco: Any, spec: Any, body: str, name: str, timestep: float) -> None:
    joint, play = spec.joint(f"{body}/{name}"), name_play(body, name)
    if spec.joint(play) is not None:
        return
    link = joint.parent
    if len(link.joints) > 1:
        raise TaskError(f"backlash of joint {name!r}: its link has several joints; give one link to each in the model")
    insert_play(mujoco, joint, play, timestep)


def set_friction_impedance(joint: Any, timestep: float) -> None:
    """Let dry friction of a joint of an `MjSpec` hold it where it is, for a physics step of `timestep` [s]."""
    joint.solref_friction, joint.solimp_friction = [2 * timestep, 1.0], _FRICTION


def insert_play(mujoco: Any, joint: Any, name: str, timestep: float) -> None:
    """Add the play of a joint of an `MjSpec`: a joint in series, whose range is written after the compilation."""
    joint.parent.add_joint(
        name=name,
        type=joint.type,
        axis=joint.axis,
        pos=joint.pos,
        limited=int(mujoco.mjtLimited.mjLIMITED_TRUE),
        range=[-1.0, 1.0],
        solref_limit=[2 * timestep, 1.0],
        solimp_limit=_STOP,
    )


def read_electric(motor: Motor) -> tuple[float, float, float]:
    """Return constant at the joint, resistance and voltage; a motor without known ones gives any torque."""
    constant, resistance = motor.joint_constant_nm_per_a, motor.resistance_ohm
    if constant is None or resistance is None:
        return 1.0, 1.0, 0.0
    return constant, resistance, motor.voltage_v or 0.0


def count_samples(delay_s: float, timestep: float) -> int:
    """Return a delay in physics steps."""
    return round(delay_s / timestep)


def delay_of(samples: float, timestep: float) -> float:
    """Return the delay [s] at which MuJoCo reads the control of so many steps before: between two of them."""
    return max(samples - 0.5, 0.0) * timestep


class MotorArrays:
    """Values of the real motors of a body, shape (joints,); a joint without one has zeros, and no limits."""

    def __init__(self, motors: Mapping[int, Motor], joints: int) -> None:
        self.is_real = np.isin(np.arange(joints), list(motors))
        self.stiffness, self.damping, self.integral = (np.zeros(joints) for _ in range(3))
        self.regulates_voltage, self.has_integral = np.zeros(joints, bool), np.zeros(joints, bool)
        self.current_torque, self.max_torque, self.stall_torque = (np.full(joints, np.inf) for _ in range(3))
        """Largest torques by the limit of the current, of the gears, and of both and of the voltage [N m or N]."""
        for joint, motor in motors.items():
            self.stiffness[joint] = motor.stiffness_nm_per_rad or 0.0
            self.damping[joint] = motor.damping_nms_per_rad
            self.integral[joint] = motor.integral_nm_per_rads
            self.has_integral[joint] = motor.integral_nm_per_rads > 0
            self.regulates_voltage[joint] = motor.regulates == "voltage"
            constant = motor.joint_constant_nm_per_a
            if constant is not None and motor.current_limit_a is not None:
                self.current_torque[joint] = constant * motor.current_limit_a
            if motor.max_torque_nm is not None:
                self.max_torque[joint] = motor.max_torque_nm
            stall = motor.stall_torque_nm
            self.stall_torque[joint] = math.inf if stall is None else stall


def list_history(model: Any, actuators: Iterable[int]) -> list[NDArray[np.int64]]:
    """Return the places of the past controls of actuators in `history`; each has one control per sample."""
    places = []
    for actuator in actuators:
        start, samples = int(model.actuator_historyadr[actuator]), int(model.actuator_history[actuator, 0])
        first = start + _HISTORY_HEADER + samples
        places.append(np.arange(first, first + samples) if samples else np.arange(0))
    return places
