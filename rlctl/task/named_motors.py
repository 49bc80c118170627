"""Motors by name: values of data sheets, and values that others have identified on a test bench, with their sources.

A value that no source gives is unset. `rlctl.task.Body.set_motors` takes these names; so does `tasks new --motors`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

from rlctl.errors import TaskError, check_name
from rlctl.task.motors import Motor

_RPM = 2 * math.pi / 60  # [rad/s]
_KGF_CM = 0.0980665  # [N m]
_DYNAMIXEL_X = 4096 / (2 * math.pi) / (128 * 885)
"""Fraction of the supply per rad and per 1 of Position P Gain: P/128 of the error in encoder steps, of 885."""
_E_MANUAL = "ROBOTIS e-Manual, emanual.robotis.com/docs/en/dxl"
_BAM = "github.com/Rhoban/bam at 1b5a1cee, bam/params"
_UNITREE = "github.com/unitreerobotics/unitree_ros, robots"


@dataclasses.dataclass(frozen=True)
class NamedMotor:
    """A motor of the table."""

    motor: Motor
    kind: Literal["data sheet", "identified"]
    source: str
    unknown: str  # what the source does not give, and what else a user should know


def _dynamixel(position_gain: float, motor: Motor) -> Motor:
    return dataclasses.replace(motor, duty_per_rad_and_gain=_DYNAMIXEL_X).at_gain(position_gain)


def _identified(voltage_v: float, duty: float, gain: float, **values: float) -> Motor:
    """Return a servo that BAM has identified (its model M1: Coulomb and viscous friction)."""
    motor = Motor(
        regulates="voltage",
        voltage_v=voltage_v,
        duty_per_rad_and_gain=duty,
        torque_constant_nm_per_a=values["constant"],
        resistance_ohm=values["resistance"],
        armature_kgm2=values["armature"],
        coulomb_friction_nm=values["coulomb"],
        viscous_friction_nms_per_rad=values["viscous"],
    )
    return motor.at_gain(gain)


_NO_PLAY = "backlash and delay are not identified"
_NO_FRICTION = "armature, friction, backlash and delay: the armature and friction of the model file hold"

TABLE: dict[str, NamedMotor] = {
    "sts3215": NamedMotor(
        _identified(
            7.4,
            0.166,
            32.0,
            constant=1.21164135,
            resistance=2.67616633,
            armature=0.02840336,
            coulomb=0.05239296,
            viscous=0.05908516,
        ),
        "identified",
        f"{_BAM}/feetech_sts3215_7_4V/m1.json, and bam/feetech/actuator.py for the gain",
        f"Feetech STS3215 at 7.4 V; {_NO_PLAY}; 1 degree of play was measured on one of 12 V (SO-ARM100 issue 134)",
    ),
    "sts3215-12v": NamedMotor(
        dataclasses.replace(
            Motor.of_line(
                voltage_v=12.0,
                stall_torque_nm=30 * _KGF_CM,
                no_load_speed_rad_per_s=45 * _RPM,
                regulates="voltage",
            ),
            duty_per_rad_and_gain=0.166,
        ).at_gain(32.0),
        "data sheet",
        "Feetech STS3215 (C018, 12 V) as quoted in github.com/TheRobotStudio/SO-ARM100/issues/134; the gain is that of "
        "the 7.4 V servo, which has the same controller",
        f"{_NO_FRICTION}; the data sheet has up to 0.5 degrees of play, and the issue measured 1 degree",
    ),
    "xl330-m288": NamedMotor(
        _identified(
            5.0,
            _DYNAMIXEL_X,
            400.0,
            constant=0.38669576,
            resistance=4.01712922,
            armature=0.00181417,
            coulomb=0.01283272,
            viscous=0.00366167,
        ),
        "identified",
        f"{_BAM}/xl330/m1.json; voltage and default gain: {_E_MANUAL}/x/xl330-m288",
        f"Dynamixel XL330-M288-T; {_NO_PLAY}",
    ),
    "xl430-w250": NamedMotor(
        _dynamixel(
            640.0,
            Motor.of_line(voltage_v=11.1, stall_torque_nm=1.4, no_load_speed_rad_per_s=57 * _RPM, regulates="voltage"),
        ),
        "data sheet",
        f"{_E_MANUAL}/x/xl430-w250",
        f"Dynamixel XL430-W250-T; {_NO_FRICTION}; its default D gain of 4000 is left out",
    ),
    "xm430-w350": NamedMotor(
        _dynamixel(
            800.0,
            Motor.of_line(voltage_v=12.0, stall_torque_nm=4.1, no_load_speed_rad_per_s=46 * _RPM, regulates="voltage"),
        ),
        "data sheet",
        f"{_E_MANUAL}/x/xm430-w350",
        f"Dynamixel XM430-W350; {_NO_FRICTION}; the data sheet has 0.25 degrees of play",
    ),
    "xl320": NamedMotor(
        _identified(
            7.4,
            0.05048199,
            32.0,
            constant=0.98694713,
            resistance=35.60909735,
            armature=0.00111895,
            coulomb=0.0275145,
            viscous=0.00331761,
        ),
        "identified",
        f"{_BAM}/xl320/m1.json, and bam/dynamixel/actuator.py for the gain; voltage: {_E_MANUAL}/x/xl320",
        f"Dynamixel XL-320; {_NO_PLAY}",
    ),
    "mx64": NamedMotor(
        _identified(
            15.0,
            0.158,
            32.0,
            constant=1.62246679,
            resistance=3.94943367,
            armature=0.01195124,
            coulomb=0.09038677,
            viscous=0.0116916,
        ),
        "identified",
        f"{_BAM}/mx64/m1.json, and bam/dynamixel/actuator.py for gain and voltage",
        f"Dynamixel MX-64; {_NO_PLAY}",
    ),
    "mx106": NamedMotor(
        _identified(
            15.0,
            0.158,
            32.0,
            constant=2.19137567,
            resistance=2.9649904,
            armature=0.02660923,
            coulomb=0.10352027,
            viscous=0.03520238,
        ),
        "identified",
        f"{_BAM}/mx106/m1.json, and bam/dynamixel/actuator.py for gain and voltage",
        f"Dynamixel MX-106; {_NO_PLAY}",
    ),
    "mg90s": NamedMotor(
        Motor.of_line(
            voltage_v=6.0,
            stall_torque_nm=2.2 * _KGF_CM,
            no_load_speed_rad_per_s=math.pi / 3 / 0.08,
            regulates="voltage",
        ),
        "data sheet",
        "MG90S-Datasheet.pdf in github.com/TrDA-hab/Projects: 2.2 kgf cm and 0.08 s for 60 degrees at 6 V",
        f"MG90S; its controller's gain, so pass stiffness_nm_per_rad; {_NO_FRICTION}",
    ),
    "unitree-a1": NamedMotor(
        Motor.of_line(voltage_v=1.0, stall_torque_nm=33.5, no_load_speed_rad_per_s=21.0, max_torque_nm=33.5),
        "data sheet",
        f"{_UNITREE}/a1_description/xacro/const.xacro: largest torque, and largest speed as that without load",
        f"Unitree A1; stiffness and damping are what you command; no supply is given: 1 V stands for all of it; "
        f"{_NO_FRICTION}",
    ),
    "unitree-go1": NamedMotor(
        Motor.of_line(
            voltage_v=1.0,
            stall_torque_nm=23.7,
            no_load_speed_rad_per_s=30.1,
            max_torque_nm=23.7,
            armature_kgm2=0.000111842 * 6**2,
        ),
        "data sheet",
        f"{_UNITREE}/go1_description: const.xacro for torque and speed, go1.urdf for the rotor's inertia; gears of 6:1",
        "Unitree Go1, hips and thighs; stiffness and damping are what you command; no supply is given: 1 V stands for "
        "all of it; friction, backlash and delay are unknown",
    ),
    "unitree-go1-calf": NamedMotor(
        Motor.of_line(
            voltage_v=1.0,
            stall_torque_nm=35.55,
            no_load_speed_rad_per_s=20.06,
            max_torque_nm=35.55,
            armature_kgm2=0.000111842 * 9**2,
        ),
        "data sheet",
        f"{_UNITREE}/go1_description: const.xacro for torque and speed, go1.urdf for the rotor's inertia; gears of 9:1",
        "Unitree Go1, calves; otherwise as unitree-go1",
    ),
}


def find_motor(motor: Motor | str) -> Motor:
    """Return a motor, or that of the table with its name; raises `TaskError` for a name that is not there."""
    if isinstance(motor, Motor):
        return motor
    check_name(motor, TABLE, "no motor", TaskError)
    return dataclasses.replace(TABLE[motor].motor, name=motor)
