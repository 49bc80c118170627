"""What a robot with legs needs to walk, scaled from robots that do to its mass and leg length.

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
class _Speeds:
    """Speeds by the root of gravity x leg length, turns by the root of gravity / leg length."""

    backwards: float
    forwards: float
    sideways: float
    turn: float
    scale: float
    turn_scale: float
    tolerance: float
    push: float


# As the tasks `walk` (12.5 kg, legs of 0.28 m) and `humanoid-walk` (26 kg, 0.6 m) of rlctl have them.
_A1 = _Speeds(0.3, 0.6, 0.24, 0.135, scale=0.3, turn_scale=0.085, tolerance=0.12, push=0.42)
_HUMANOID = _Speeds(0.12, 0.33, 0.12, 0.148, scale=0.2, turn_scale=0.12, tolerance=0.08, push=0.2)


@dataclasses.dataclass(frozen=True)
class ScaledRobot:
    """Values of a robot with legs, and those of the A1."""

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
    period: float  # [s], of two steps in time with a clock; 0.7 of the humanoid
    swing: float  # [m], how high a foot is lifted; 0.07 of the humanoid


def scale(mass: float, stance: Stance, legs: int) -> ScaledRobot:
    """Return the values of a robot of `mass` [kg] in its stance. Numbers in the code have no unit."""
    length, of = stance.leg_length, _HUMANOID if legs == 2 else _A1
    time = math.sqrt(length / GRAVITY)
    speed, torque = length / time, mass * GRAVITY * length
    return ScaledRobot(
        stiffness=_round(torque),
        damping=_round(0.12 * torque * time),
        gear_damping=_round(0.05 * torque * time),
        armature=_round(0.01 * mass * length**2),
        lowest=(_round(-of.backwards * speed), _round(-of.sideways * speed), _round(-of.turn / time)),
        highest=(_round(of.forwards * speed), _round(of.sideways * speed), _round(of.turn / time)),
        speed_scale=_round(of.scale * speed),
        turn_scale=_round(of.turn_scale / time),
        tolerance=_round(of.tolerance * speed),
        push=_round(of.push * speed),
        bounce=_round(-0.082 / speed**2),
        sway=_round(-0.175 * time**2),
        height=_round(-0.157 / length**2),
        start_height=round(stance.height + _DROP * length, 3),
        fallen_height=round(stance.height - _SUNK * stance.clearance, 3),
        period=_round(2.8 * time),
        swing=_round(0.12 * length),
    )


def _round(value: float) -> float:
    return float(f"{value:.2g}")
