"""The joints of a model as a tree, and positions of those that equalities, mimic joints and loops couple to others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rlctl.tasks.shapes import Array

if TYPE_CHECKING:
    from rlctl.task.mujoco.body import MujocoBody

_STEPS, _CLOSE = 40, 1e-6  # -, [m or rad]
_LONGEST = 0.2  # [rad or m], of a step of one joint
_RANK = 1e-3  # of the largest singular value
_UNLIMITED = np.pi / 2  # [rad], of a joint without limits, to each side
_SLIDE = 2  # mjJNT_SLIDE


class Linkage:
    """A body in MuJoCo whose joints are placed without simulation."""

    def __init__(self, body: MujocoBody) -> None:
        import mujoco

        self._mujoco, self.body = mujoco, body
        self.model: Any = body._sim.model
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
        self.data: Any = mujoco.MjData(self.model)
        self.count = len(body.joint_names)
        self.numbers = np.array(body.parts.joints, int)
        self.places = np.arange(self.model.nq)[body.parts.positions]
        self.dofs = np.arange(self.model.nv)[body.parts.velocities]
        self.parents = self._find_parents()

    def _find_parents(self) -> list[int]:
        """Return the joint before each joint on the way from the base, -1 for the first."""
        model, parents = self.model, []
        owners = model.jnt_bodyid[self.numbers].tolist()
        for index, owner in enumerate(owners):
            before = [other for other in range(index) if owners[other] == owner]
            number = owner
            while not before and number:
                number = int(model.body_parentid[number])
                before = [other for other in range(self.count) if owners[other] == number]
            parents.append(before[-1] if before else -1)
        return parents

    def list_loops(self) -> list[set[str]]:
        """Return the pairs of links that equalities connect: they close loops of links."""
        model, kinds = self.model, self._mujoco.mjtEq
        closing = (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD))
        is_site = int(self._mujoco.mjtObj.mjOBJ_SITE)
        links = {number: name for name, number in self.body.parts.links.items()}
        pairs = []
        for equality in range(model.neq):
            ends = [int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])]
            if int(model.eq_objtype[equality]) == is_site:
                ends = [int(model.site_bodyid[end]) for end in ends]
            if int(model.eq_type[equality]) in closing:
                pairs.append({links.get(end, "") for end in ends})
        return pairs

    def join_loops(self, groups: list[list[str]]) -> list[list[str]]:
        """Return groups of links, where those that a loop connects are one."""
        joined = groups
        for pair in self.list_loops():
            touched = [group for group in joined if pair & set(group)]
            joined = [group for group in joined if group not in touched]
            joined += [[link for group in touched for link in group]] if touched else []
        return joined

    def list_beyond(self, joint: int) -> list[int]:
        """Return the joints that a joint carries, in the model's order."""
        chosen = {joint}
        for index, parent in enumerate(self.parents):
            if parent in chosen:
                chosen.add(index)
        return sorted(chosen - {joint})

    def list_chain(self, joint: int) -> list[int]:
        """Return the joints from the base to a joint, and that joint."""
        chain = []
        while joint >= 0:
            chain.append(joint)
            joint = self.parents[joint]
        return chain[::-1]

    def list_links(self, joint: int) -> list[str]:
        """Return the links that move with a joint and with none beyond it; of -1 those that no joint moves."""
        owners = {int(owner): index for index, owner in enumerate(self.model.jnt_bodyid[self.numbers])}
        links = []
        for name, link in self.body.parts.links.items():
            number = link
            while number and number not in owners:
                number = int(self.model.body_parentid[number])
            if owners.get(number, -1) == joint:
                links.append(name)
        return links

    def slides(self, joint: int) -> bool:
        """Return whether a joint slides."""
        return int(self.model.jnt_type[self.numbers[joint]]) == _SLIDE

    def find_ends(self, joint: int) -> tuple[float, float]:
        """Return the limits of a joint [rad or m], or a quarter turn to each side."""
        low, high = float(self.body.joint_low[joint]), float(self.body.joint_high[joint])
        if not np.isfinite([low, high]).all():
            return -_UNLIMITED, _UNLIMITED
        return low, high

    def place(self, positions: Array) -> None:
        """Place all joints, shape (joints,)."""
        self.data.qpos[self.places] = positions
        self._mujoco.mj_kinematics(self.model, self.data)

    def frame(self, link: str) -> tuple[Array, Array]:
        """Return the rotation matrix and the position [m] of a link's frame."""
        number = self.body.parts.links[link]
        return self.data.xmat[number].reshape(3, 3).copy(), self.data.xpos[number].copy()

    def axis(self, joint: int) -> tuple[Array, Array]:
        """Return a point on a joint's axis [m] and its direction, world frame."""
        number = self.numbers[joint]
        return self.data.xanchor[number].copy(), self.data.xaxis[number].copy()

    def choose_drivers(self, joints: Sequence[int]) -> list[int]:
        """Return the fewest of some joints that define the positions of all of them.

        Joints with an actuator of the model go first, then those that no equality makes follow another joint. Joints
        without an actuator are left to their springs if others have one, as in grippers that adapt to what they hold.
        """
        if not self.model.neq:
            return list(joints)
        _, matrix = self._measure(self.body.joint_positions)
        rank, dependent = _find_rank(matrix[:, self.dofs[list(joints)]]), list(joints)
        actuated, followers = self._find_actuated(), self._find_followers()
        for joint in sorted(joints, key=lambda joint: (joint not in actuated, joint in followers)):
            rest = [other for other in dependent if other != joint]
            if len(dependent) > rank and _find_rank(matrix[:, self.dofs[rest]]) == rank:
                dependent = rest
        drivers = [joint for joint in joints if joint not in dependent]
        return [joint for joint in drivers if joint in actuated] or drivers

    def _find_actuated(self) -> set[int]:
        """Return the joints that actuators of the model's file move, directly or by a tendon."""
        model, kinds = self.model, self._mujoco.mjtTrn
        moved: set[int] = set()
        for motor in self.body.parts.own_motors.tolist():
            target, kind = int(model.actuator_trnid[motor, 0]), int(model.actuator_trntype[motor])
            if kind == int(kinds.mjTRN_JOINT):
                moved.add(target)
            elif kind == int(kinds.mjTRN_TENDON):
                first, count = int(model.tendon_adr[target]), int(model.tendon_num[target])
                wraps = range(first, first + count)
                is_joint = int(self._mujoco.mjtWrap.mjWRAP_JOINT)
                moved |= {int(model.wrap_objid[wrap]) for wrap in wraps if int(model.wrap_type[wrap]) == is_joint}
        return {index for index, number in enumerate(self.numbers.tolist()) if number in moved}

    def _find_followers(self) -> set[int]:
        """Return the joints that an equality or a mimic joint makes follow another."""
        model, kind = self.model, int(self._mujoco.mjtEq.mjEQ_JOINT)
        numbers = {int(model.eq_obj1id[eq]) for eq in range(model.neq) if int(model.eq_type[eq]) == kind}
        return {index for index, number in enumerate(self.numbers.tolist()) if number in numbers}

    def close_loops(self, positions: Array, dependent: Sequence[int]) -> Array:
        """Return positions of all joints in which some are moved so that the model's equalities hold.

        Where these leave joints free, the joints' springs move them, up to their limits.
        """
        positions = np.array(positions, float)
        if not dependent or not self.model.neq:
            return positions
        chosen = list(dependent)
        positions = self._solve_loops(positions, chosen)
        springs = self.model.jnt_stiffness[self.numbers[chosen]]
        return self._relax(positions, chosen, springs) if springs.any() else positions

    def _solve_loops(self, positions: Array, chosen: list[int]) -> Array:
        for _ in range(_STEPS):
            missing, matrix = self._measure(positions)
            if not len(missing) or np.abs(missing).max() < _CLOSE:
                break
            step = -np.linalg.lstsq(matrix[:, self.dofs[chosen]], missing, rcond=_RANK)[0]
            step *= min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-9))
            positions[chosen] += step
        return positions

    def _relax(self, positions: Array, chosen: list[int], springs: Array) -> Array:
        """Move joints by their springs in the directions that the equalities and the limits leave free."""
        rest = self.model.qpos_spring[self.places[chosen]]
        low, high = np.array([self.find_ends(joint) for joint in chosen]).T
        for _ in range(_STEPS):
            pull = springs * (rest - positions[chosen]) / springs.max()
            matrix = self._measure(positions)[1][:, self.dofs[chosen]]
            step = _project(pull, matrix, np.zeros(len(chosen), bool))
            moved = positions[chosen] + step
            stopped = (moved < low) & (positions[chosen] <= low + _CLOSE)
            stopped |= (moved > high) & (positions[chosen] >= high - _CLOSE)
            step = _project(pull, matrix, stopped)
            longest = float(np.abs(step).max())
            if longest < _CLOSE:
                break
            step *= min(1.0, _LONGEST / 2 / longest)
            positions[chosen] = np.clip(positions[chosen] + step, low, high)
            positions = self._solve_loops(positions, chosen)
        return positions

    def _measure(self, positions: Array) -> tuple[Array, Array]:
        """Return by how much the equalities are missed, shape (rows,), and their derivatives, shape (rows, nv)."""
        self.data.qpos[self.places] = positions
        self._mujoco.mj_fwdPosition(self.model, self.data)
        rows = self.data.efc_type == int(self._mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        matrix = np.array(self.data.efc_J).reshape(-1, self.model.nv)
        return self.data.efc_pos[rows].copy(), matrix[rows]


def _project(step: Array, matrix: Array, stopped: Array) -> Array:
    """Return the part of a step of joints that the rows of a matrix do not see, and that moves none that is stopped."""
    rows = np.concatenate([matrix, np.eye(len(step))[stopped]])
    part: Array = step - np.linalg.pinv(rows, rcond=_RANK) @ (rows @ step)
    return part


def _find_rank(matrix: Array) -> int:
    if not matrix.size:
        return 0
    return int(np.linalg.matrix_rank(matrix, tol=_RANK * max(1e-9, float(np.linalg.norm(matrix, 2)))))
