"""Builds the clips of `humanoid-bow` and `quadruped-bow` from keyframes: python -m rlctl_locomotion.make_clips.

Feet stay where they stand. The humanoid's ankles keep its centre of mass above its feet; the legs of the A1 follow from
the trunk by inverse kinematics.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.task.motion import MotionClip, write_motion
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.rotations import from_axis, rotate
from rlctl_locomotion.humanoid_walk import JOINTS as HUMANOID_JOINTS
from rlctl_locomotion.humanoid_walk import SOLE, HumanoidWalk
from rlctl_locomotion.quadruped import FEET as QUADRUPED_FEET
from rlctl_locomotion.quadruped import JOINTS as QUADRUPED_JOINTS

CLIPS = Path(__file__).with_name("clips")
RATE = 50.0  # [1/s]
_AHEAD = 0.03  # [m], of the humanoid's ankles: the middle of its feet
_TOE = 0.02  # [m], radius of the A1's feet
_LEFT = (0.0, 1.0, 0.0)

# Time [s], pitch of the trunk, knees, shoulders, elbows [rad].
HUMANOID_KEYS = (
    (0.0, 0.0, 0.6, 0.1, -0.5),
    (0.6, 0.0, 0.6, 0.1, -0.5),
    (1.8, 0.7, 0.5, 0.5, -0.2),
    (2.4, 0.7, 0.5, 0.5, -0.2),
    (3.6, 0.0, 0.6, 0.1, -0.5),
    (4.6, 0.25, 1.5, -1.3, -0.3),
    (5.0, 0.25, 1.5, -1.3, -0.3),
    (6.0, 0.0, 0.6, 0.1, -0.5),
    (6.6, 0.0, 0.6, 0.1, -0.5),
)
# Time [s], pitch of the trunk [rad], forwards and upwards [m] from the stance.
QUADRUPED_KEYS = (
    (0.0, 0.0, 0.0, 0.0),
    (0.6, 0.0, 0.0, 0.0),
    (1.6, 0.35, -0.03, -0.05),
    (2.4, 0.35, -0.03, -0.05),
    (3.4, -0.15, 0.0, -0.03),
    (3.8, -0.15, 0.0, -0.03),
    (4.8, 0.0, 0.0, 0.0),
    (5.4, 0.0, 0.0, 0.0),
)


def blend(keys: Sequence[Sequence[float]]) -> np.ndarray:
    """Return keyframes at `RATE`, at rest in each of them, with the least jerk between; without their times."""
    table = np.array(keys)
    times = np.arange(round(table[-1, 0] * RATE) + 1) / RATE
    before = np.clip(np.searchsorted(table[:, 0], times, side="right") - 1, 0, len(table) - 2)
    part = (times - table[before, 0]) / (table[before + 1, 0] - table[before, 0])
    smooth = part**3 * (10 - 15 * part + 6 * part**2)
    rows: np.ndarray = table[before, 1:] + smooth[:, None] * (table[before + 1, 1:] - table[before, 1:])
    return rows


def make_humanoid_bow() -> MotionClip:
    """Return a bow and a squat of the humanoid."""
    body = MujocoSim(control_dt=0.02, substeps=1).load("robot", HumanoidWalk.model)
    data, trunk = body._sim.data, body.find_link(body.base_name)
    body.set_base((0.0, 0.0, 0.0))
    origin = -body.link_position(body.base_name)

    def place(pitch: float, knee: float, shoulder: float, elbow: float, ankle: float) -> tuple[Any, Any, Any, float]:
        hip = -pitch - knee - ankle
        joints = np.array([0.0, 0.0, hip, knee, ankle, 0.0] * 2 + [shoulder, elbow] * 2)
        turn = from_axis(_LEFT, pitch)
        body.set_base(rotate(turn, origin), turn)
        body.set_joints(joints)
        foot = body.link_position("left_foot")
        ahead = float(data.subtree_com[trunk, 0] - foot[0])
        position = np.array([-foot[0], 0.0, SOLE - foot[2]])
        return position, turn, joints, ahead

    def balance(row: Sequence[float]) -> tuple[Any, Any, Any, float]:
        pitch, knee, shoulder, elbow = row
        low, high = -0.9, 0.6  # [rad], of the ankles: the farther up the toes, the farther back the trunk
        for _ in range(40):
            middle = (low + high) / 2
            found = place(pitch, knee, shoulder, elbow, middle)
            low, high = (middle, high) if found[3] > _AHEAD else (low, middle)
        return found

    return _collect("humanoid-bow", HUMANOID_JOINTS, blend(HUMANOID_KEYS), balance)


def make_quadruped_bow() -> MotionClip:
    """Return a bow of the A1, and the opposite."""
    import mujoco

    body = MujocoSim(control_dt=0.02, substeps=1).load("robot", "a1.urdf")
    model, data = body._sim.model, body._sim.data
    body.set_base((0.0, 0.0, 0.0))
    origin = -body.link_position(body.base_name)
    joints = np.array([0.0, 0.8, -1.6] * 4)
    body.set_joints(joints)
    links = [body.find_link(foot) for foot in QUADRUPED_FEET]
    feet = np.array([body.link_position(foot) for foot in QUADRUPED_FEET]) + origin  # relative to the trunk's frame
    height = _TOE - float(feet[:, 2].mean())
    stands = feet + np.array([0.0, 0.0, height])
    columns = model.jnt_dofadr[body.parts.joints]

    def reach(row: Sequence[float]) -> tuple[Any, Any, Any, float]:
        pitch, forwards, upwards = row
        turn, position = from_axis(_LEFT, pitch), np.array([forwards, 0.0, height + upwards])
        body.set_base(position + rotate(turn, origin), turn)
        for _ in range(20):
            body.set_joints(joints)
            mujoco.mj_fwdPosition(model, data)
            for link, place in zip(links, stands, strict=True):
                slope = np.zeros((3, model.nv))
                mujoco.mj_jacBody(model, data, slope, None, link)
                joints[:] += np.linalg.pinv(slope[:, columns], rcond=1e-3) @ (place - data.xpos[link])
        return position, turn, joints.copy(), 0.0

    return _collect("quadruped-bow", QUADRUPED_JOINTS, blend(QUADRUPED_KEYS), reach)


def _collect(
    name: str, joints: Sequence[str], rows: np.ndarray, place: Callable[[Sequence[float]], tuple[Any, Any, Any, float]]
) -> MotionClip:
    placed = [place(row) for row in rows.tolist()]
    positions, turns, angles = (np.array([frame[part] for frame in placed]) for part in range(3))
    return MotionClip(name, RATE, positions, turns, list(joints), angles)


if __name__ == "__main__":
    for motion in (make_humanoid_bow(), make_quadruped_bow()):
        (CLIPS / f"{motion.name}.csv").write_bytes(write_motion(motion))
