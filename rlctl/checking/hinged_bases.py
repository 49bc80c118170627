"""Robots that turn about a vertical hinge on the world of an engine, alone or after two slides in the plane."""

import dataclasses
import sys
from typing import Any

import numpy as np

from rlctl.checking.bullet_worlds import read_world
from rlctl.checking.instance import Instance
from rlctl.checking.mujoco_worlds import FREE, HINGE, SLIDE
from rlctl.environments.bullet_clients import ClientCalls
from rlctl.environments.simulations import find_mujoco
from rlctl.task.rotations import from_axis, multiply, rotate

UP, UPRIGHT = (0.0, 0.0, 1.0), 1 - 1e-6
NEAR = 1e-6  # how far from the origin a hinge may be [m]
CONTINUOUS = 0  # PyBullet's type of a joint that turns


@dataclasses.dataclass(frozen=True)
class HingedBase:
    """A robot whose first joint is a vertical hinge at the origin of the world, without limits."""

    name: str
    model: Any = None  # MuJoCo's
    data: Any = None
    joint: int = -1
    slides: tuple[int, ...] = ()  # joints along x and y
    client: int = -1  # PyBullet's
    body: int = -1

    def read(self) -> float:
        """Return the heading [rad]."""
        if self.data is not None:
            return float(self.data.qpos[self.model.jnt_qposadr[self.joint]])
        return float(ClientCalls(self.client).getJointState(self.body, self.joint)[0])

    def turn(self, angle: float) -> None:
        """Turn the robot, and all that is free, about the origin [rad]."""
        if self.data is not None:
            self._turn_in_mujoco(angle)
            return
        p = ClientCalls(self.client)
        position, speed, *_ = p.getJointState(self.body, self.joint)
        p.resetJointState(self.body, self.joint, position + angle, speed)
        for body in read_world(self.client).bodies:
            if body.is_free:
                place, orientation = p.getBasePositionAndOrientation(body.id)
                linear, angular = p.getBaseVelocity(body.id)
                turn = from_axis(UP, angle)
                turned = multiply(turn, np.array(orientation)).tolist()
                p.resetBasePositionAndOrientation(body.id, rotate(turn, place).tolist(), turned)
                p.resetBaseVelocity(body.id, rotate(turn, linear).tolist(), rotate(turn, angular).tolist())

    def _turn_in_mujoco(self, angle: float) -> None:
        model, data = self.model, self.data
        data.qpos[model.jnt_qposadr[self.joint]] += angle
        turn = from_axis(UP, angle)
        if self.slides:
            places, dofs = (address[list(self.slides)] for address in (model.jnt_qposadr, model.jnt_dofadr))
            origin = model.body_pos[model.jnt_bodyid[self.joint]][:2]
            data.qpos[places] = rotate(turn, [*(origin + data.qpos[places]), 0.0])[:2] - origin
            data.qvel[dofs] = rotate(turn, [*data.qvel[dofs], 0.0])[:2]
        for joint in np.flatnonzero(model.jnt_type == FREE):
            place, first = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            data.qpos[place : place + 3] = rotate(turn, data.qpos[place : place + 3])
            quaternion = np.roll(data.qpos[place + 3 : place + 7], -1)
            data.qpos[place + 3 : place + 7] = np.roll(multiply(turn, quaternion), 1)
            data.qvel[first : first + 3] = rotate(turn, data.qvel[first : first + 3])
        sys.modules["mujoco"].mj_forward(model, data)


def has_engine(instance: Instance) -> bool:
    """Say whether the robot is in PyBullet or MuJoCo."""
    return find_mujoco(instance.env) is not None or any(read_world(c).bodies for c in instance.find_clients())


def find_hinged_base(instance: Instance) -> HingedBase | None:
    """Return the only such robot of an instance; None where there is none."""
    if (simulation := find_mujoco(instance.env)) is not None:
        found = _list_in_mujoco(*simulation)
    else:
        found = [base for client in instance.find_clients() for base in _list_in_bullet(client)]
    return found[0] if len(found) == 1 else None


def _list_in_mujoco(model: Any, data: Any) -> list[HingedBase]:
    found = []
    for joint in np.flatnonzero((model.jnt_type == HINGE) & (model.jnt_limited == 0)):
        body = int(model.jnt_bodyid[joint])
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        before = range(first, int(joint))
        is_last = joint == first + count - 1
        slides = tuple(before) if [int(model.jnt_type[one]) for one in before] == [SLIDE] * 2 else ()
        if not is_last or bool(before) != bool(slides) or not _is_on_the_world(model, body):
            continue
        if abs(data.xaxis[joint][2]) < UPRIGHT or data.xaxis[joint][2] < 0:
            continue
        is_level = [np.allclose(model.jnt_axis[one], axis) for one, axis in zip(slides, np.eye(3), strict=False)]
        is_central = bool(slides) or np.linalg.norm(data.xanchor[joint][:2]) < NEAR
        if all(is_level) and is_central:
            name = model.joint(int(joint)).name or f"joint {joint}"
            found.append(HingedBase(name, model, data, int(joint), slides))
    return found


def _is_on_the_world(model: Any, body: int) -> bool:
    """Say whether nothing moves below a body."""
    parent = int(model.body_parentid[body])
    return int(model.body_weldid[parent]) == 0


def _list_in_bullet(client: int) -> list[HingedBase]:
    p, found = ClientCalls(client), []
    for body in read_world(client).bodies:
        if body.is_free or not p.getNumJoints(body.id):
            continue
        for joint in range(p.getNumJoints(body.id)):
            info = p.getJointInfo(body.id, joint)
            if info[2] == CONTINUOUS:
                state = p.getLinkState(body.id, joint, computeForwardKinematics=True)
                axis = rotate(state[5], info[13])
                has_limits = info[8] < info[9]
                is_central = np.linalg.norm(state[4][:2]) < NEAR
                if info[16] == -1 and not has_limits and axis[2] > UPRIGHT and is_central:
                    found.append(HingedBase(info[1].decode(), joint=joint, client=client, body=body.id))
                break
    return found
