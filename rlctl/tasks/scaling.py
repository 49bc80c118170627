"""What a robot with legs needs to walk, scaled from Unitree's A1 to its mass and leg length.

Robots of equal shape move alike if lengths scale with the leg length, masses with the mass, and times with the root of
leg length / gravity: then speed^2 / (gravity x leg length), the Froude number, is the same.
"""

import dataclasses
import math

from rlctl.tasks.stance import Stance

GRAVITY = 9.81  # [m/s^2]
_DROP = 0.05  # of the leg length: height above the stance at the start of an episode
_SUNK = 0.65  # of the space under the trunk that it has lost when it has fallen


@dataclasses.dataclass(frozen=True)
class ScaledA1:
    """Values as the task `walk` of rlctl has them for the A1: 12.5 kg with legs of 0.28 m."""

    stiffness: float  # [N m/rad]; 35 of the A1
    damping: float  # [N m s/rad]; 0.7
    gear_damping: float  # [N m s/rad]; 0.3
    armature: float  # [kg m^2]; 0.01
    lowest: tuple[float, float, float]  # velocities forwards, to the left [m/s], of turning [rad/s]; -0.5, -0.4, -0.8
    highest: tuple[float, float, float]  # 1, 0.4, 0.8
    speed_scale: float  # [m/s]; 0.5
    turn_scale: float  # [rad/s]; 0.5
    tolerance: float  # [m/s]; 0.2
    push: float  # [m/s]; 0.7
    bounce: float  # weight of squares of [m/s]; -0.03
    sway: float  # weight of squares of [rad/s]; -0.005
    height: float  # weight of squares of [m]; -2
    start_height: float  # [m], of the trunk's centre of mass
    fallen_height: float  # [m]


def scale_a1(mass: float, stance: Stance) -> ScaledA1:
    """Return the values of a robot of `mass` [kg] in its stance. Numbers in the code have no unit."""
    length = stance.leg_length
    time = math.sqrt(length / GRAVITY)
    speed, torque = length / time, mass * GRAVITY * length
    return ScaledA1(
        stiffness=_round(torque),
        damping=_round(0.12 * torque * time),
        gear_damping=_round(0.05 * torque * time),
        armature=_round(0.01 * mass * length**2),
        lowest=(_round(-0.3 * speed), _round(-0.24 * speed), _round(-0.135 / time)),
        highest=(_round(0.6 * speed), _round(0.24 * speed), _round(0.135 / time)),
        speed_scale=_round(0.3 * speed),
        turn_scale=_round(0.085 / time),
        tolerance=_round(0.12 * speed),
        push=_round(0.42 * speed),
        bounce=_round(-0.082 / speed**2),
        sway=_round(-0.175 * time**2),
        height=_round(-0.157 / length**2),
        start_height=round(stance.height + _DROP * length, 3),
        fallen_height=round(stance.height - _SUNK * stance.clearance, 3),
    )


def _round(value: float) -> float:
    return float(f"{value:.2g}")
