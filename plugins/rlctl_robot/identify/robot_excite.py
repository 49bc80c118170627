"""A motion to record, for the servos of a robot: each joint alone, then all, within their limits."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from rlctl import output
from rlctl.errors import AnswerIsNo, UsageError
from rlctl.task.mujoco.world import import_mujoco
from rlctl_robot.identify.log import Array
from rlctl_robot.identify.motion import write_motion
from rlctl_robot.identify.robot_model import (
    ARMATURE,
    COULOMB,
    STIFFNESS,
    VISCOUS,
    RobotModel,
    Values,
    read_robot,
    stack_values,
)
from rlctl_robot.identify.windows import WindowPlayer

_ALONE = 0.4  # of the time, in which one joint moves after the other
_SINES = 6
_LOWEST_HZ, _HIGHEST_HZ = 0.15, 2.5
_MARGIN = 0.1  # of a joint's range that is left at both ends
_WIDEST = 1.2  # [rad or m], to each side of the pose
_FADE_S = 0.4
_USUAL_SPEED = 6.0  # [rad/s or m/s], of a joint whose file gives no limit
_AMPLITUDES = (0.7, 0.5, 0.35, 0.25, 0.15, 0.08)
_SHORTEST_S = 10.0
_USUAL_HZ = 6.0  # of a servo whose stiffness is not known
_USUAL_FRICTION = 0.02


@dataclasses.dataclass(frozen=True)
class RobotExcitation:
    """A motion that was simulated without leaving the limits."""

    path: Path
    robot: Path
    seconds: float
    rate: float  # rows per second
    amplitude: float  # fraction of the joints' ranges without margins
    fastest: float  # [rad/s or m/s]


def write_robot_excitation(
    file: str, path: Path, *, seconds: float, rate: float, seed: int, threads: int = 0
) -> RobotExcitation:
    """Write the largest motion that is safe in simulation: targets, and the positions that the simulation reaches.

    Safe: every joint stays 10 % of its range away from its ends and below its top speed, and no links touch that do not
    touch in the first pose. Raises `AnswerIsNo` if even a small motion is not safe.
    """
    if seconds < _SHORTEST_S:
        raise UsageError(f"--seconds {seconds:g}: the joints of a robot move one after the other; give 10 or more")
    robot, solid = read_robot(file), read_robot(file, collides=True)
    values = _guess_values(robot)
    reason = ""
    for amplitude in _AMPLITUDES:
        targets = draw_targets(robot, seconds, 1 / rate, amplitude, seed)
        player = WindowPlayer(robot, targets, 1 / rate, threads)
        still = np.zeros((1, len(robot.joints)))
        played = player.play(stack_values(values, 1), np.zeros(1, int), targets[:1], still, len(targets) - 1)[0]
        reason = _find_danger(robot, played, rate) or _find_contact(solid, played)
        if not reason:
            write_motion(path, robot.joints, targets, played, 1 / rate)
            fastest = float(np.abs(np.diff(played, axis=0)).max() * rate)
            return RobotExcitation(path, robot.path, seconds, rate, amplitude, fastest)
    raise AnswerIsNo(f"{robot.path}: no safe motion found: even at {_AMPLITUDES[-1]:.0%} of the ranges, {reason}")


def show_robot_excitation(result: RobotExcitation, json: str | None) -> None:
    """Print the motion's file, how large it is, and what to do with it."""
    if output.present(result, json):
        return
    output.out().print(
        f"{result.path}: {result.seconds:g} s for {result.robot.name}, {result.rate:g} targets per second: each joint "
        f"alone, then all, {result.amplitude:.0%} of their ranges, up to {result.fastest:.2g} rad/s\n"
        "in simulation the joints keep their limits and links touch nothing; the robot's cables and surroundings are "
        "not simulated\nfix its base on a stand, send the columns target_JOINT to its servos, write what the encoders "
        f"read into position_JOINT, then: rlctl identify {result.robot} --log FILE"
    )


def draw_targets(robot: RobotModel, seconds: float, control_dt: float, amplitude: float, seed: int) -> Array:
    """Return targets [rad or m], shape (rows, joints): each joint alone for 40 % of the time, then all."""
    rng = np.random.default_rng(seed)
    joints, count = len(robot.joints), round(seconds / control_dt)
    pose, room = _choose_pose(robot)
    time: Array = np.arange(count) * np.float64(control_dt)
    targets = np.repeat(pose[None], count, axis=0)
    alone = _ALONE * seconds / joints
    for joint in range(joints):
        for begin, end in ((joint * alone, (joint + 1) * alone), (_ALONE * seconds, seconds)):
            rows = np.flatnonzero((time >= begin) & (time < end))
            top = robot.max_speed[joint] or _USUAL_SPEED
            wave, speed = _draw_wave(time[rows] - begin, end - begin, rng)
            size = min(amplitude * room[joint], 0.6 * amplitude * top / speed)
            targets[rows, joint] += size * wave
    return targets


def _draw_wave(time: Array, length: float, rng: np.random.Generator) -> tuple[Array, float]:
    """Return a sum of sines in [-1, 1] that begins and ends at 0, and its largest speed [1/s]."""
    lowest = max(_LOWEST_HZ, 1 / length)
    hertz = np.exp(rng.uniform(np.log(lowest), np.log(_HIGHEST_HZ), _SINES))
    phases = rng.uniform(0, 2 * np.pi, _SINES)
    wave = (np.sin(2 * np.pi * hertz * time[:, None] + phases) / np.sqrt(hertz)).sum(axis=1)
    wave *= np.clip(np.minimum(time, length - time) / _FADE_S, 0, 1)
    wave /= max(float(np.abs(wave).max()), 1e-9)
    step = float(time[1] - time[0]) if len(time) > 1 else 1.0
    return wave, max(float(np.abs(np.diff(wave)).max() / step), 1e-9)


def _choose_pose(robot: RobotModel) -> tuple[Array, Array]:
    """Return the pose around which the joints move, and how far they may, to each side."""
    limited = np.isfinite(robot.high - robot.low)
    low = np.where(limited, robot.low + _MARGIN * (robot.high - robot.low), -np.inf)
    high = np.where(limited, robot.high - _MARGIN * (robot.high - robot.low), np.inf)
    middle = np.where(limited, (robot.low + robot.high) / 2, 0.0)
    start = robot.model.qpos0
    room = np.minimum(start - low, high - start)
    # The middle of the range gives a joint more room than where the file has it, but may be an unusual pose.
    is_narrow = room < 0.3 * np.where(limited, (high - low) / 2, 1.0)
    pose = np.where(is_narrow, middle, start)
    return pose, np.minimum(np.minimum(pose - low, high - pose), _WIDEST)


def _guess_values(robot: RobotModel) -> Values:
    """Return values with which the servos follow: those of the file, or usual ones where it has none."""
    inertia = 1.0 / np.maximum(robot.model.dof_invweight0, 1e-9)
    values = dict(robot.nominal)
    stiffness = inertia * (2 * np.pi * _USUAL_HZ) ** 2
    values[STIFFNESS] = np.where(np.isnan(values[STIFFNESS]), stiffness, values[STIFFNESS])
    values[ARMATURE] = np.maximum(values[ARMATURE], 0.1 * inertia)
    critical = 2 * np.sqrt(values[STIFFNESS] * inertia)
    values[VISCOUS] = np.maximum(values[VISCOUS], 0.7 * critical)
    values[COULOMB] = np.maximum(values[COULOMB], _USUAL_FRICTION * values[STIFFNESS] * 0.1)
    return values


def _find_danger(robot: RobotModel, played: Array, rate: float) -> str:
    """Return why a motion is not safe for the joints, or empty."""
    speeds = np.abs(np.diff(played, axis=0)).max(axis=0) * rate
    for joint, name in enumerate(robot.joints):
        width = robot.high[joint] - robot.low[joint]
        if np.isfinite(width):
            margin = 0.5 * _MARGIN * width
            low, high = robot.low[joint] + margin, robot.high[joint] - margin
            if played[:, joint].min() < low or played[:, joint].max() > high:
                return f"joint {name} comes near the end of its range"
        top = robot.max_speed[joint]
        if top > 0 and speeds[joint] > top:
            return f"joint {name} is faster than its top speed, {top:.3g} rad/s"
    return ""


def _find_contact(solid: RobotModel, played: Array) -> str:
    """Return which links touch in a motion and not in its first pose, or empty."""
    mujoco, model = import_mujoco(), solid.model
    data = mujoco.MjData(model)
    first: set[tuple[int, int]] = set()
    for row, positions in enumerate(played):
        data.qpos[:] = positions
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for pair in _list_touching(model, data):
            if row == 0:
                first.add(pair)
            elif pair not in first:
                names = [model.body(body).name for body in pair]
                return f"{names[0]} touches {names[1]}"
    return ""


def _list_touching(model: Any, data: Any) -> set[tuple[int, int]]:
    """Return pairs of bodies that touch; the world is none, since the robot stands elsewhere."""
    pairs = set()
    for contact in data.contact[: data.ncon]:
        one, other = sorted(int(model.geom_bodyid[geom]) for geom in contact.geom)
        if one > 0 and contact.dist <= 0:
            pairs.add((one, other))
    return pairs
