"""Properties of a body that events change until the next reset: mass, friction, damping, colour."""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

from rlctl.errors import TaskError, check_name
from rlctl.task.pybullet.library import pybullet
from rlctl.task.pybullet.motors import Motors

_RAIL = 100.0  # [m]
_RIGID = 1e12  # [N/m]


class _Dynamics(NamedTuple):
    mass: float  # [kg]
    friction: float
    inertia: tuple[float, float, float]  # [kg m^2]


class Properties(Motors):
    """The part of `PybulletBody` whose values events change; a reset restores the values of the built world."""

    _links: dict[str, int]

    def __init__(self) -> None:
        super().__init__()
        self._changed: set[str] = set()  # kinds of properties that events have changed

    # PyBullet's saved states have positions and velocities, but none of these values.

    def _save_nominal(self) -> None:
        super()._save_nominal()
        self._changed &= {"_contacts"}
        for values in ("_dynamics", "_damping", "_colors"):
            self.__dict__.pop(values, None)  # read again when needed: `build` may have set others

    def _restore_nominal(self) -> None:
        super()._restore_nominal()
        if "_dynamics" in self._changed:
            for link, (mass, friction, inertia) in self._dynamics.items():
                self._change(link, mass=mass, lateralFriction=friction, localInertiaDiagonal=inertia)
        if "_damping" in self._changed:
            for link, damping in zip(self.joint_indices, self._damping, strict=True):
                self._change(link, jointDamping=damping)
        if "_colors" in self._changed:
            for (link, shape), color in self._colors.items():
                self._paint(link, shape, color)
        if "_contacts" in self._changed:
            self.set_contact_stiffness(_RIGID)
        self._changed.clear()

    @cached_property
    def _dynamics(self) -> dict[int, _Dynamics]:
        return {
            link: _Dynamics(*pybullet.getDynamicsInfo(self.id, link, physicsClientId=self.client)[:3])
            for link in range(-1, len(self._links))
        }

    @cached_property
    def _damping(self) -> list[float]:
        pybullet.syncBodyInfo(physicsClientId=self.client)  # without it getJointInfo returns the values of the file
        return [pybullet.getJointInfo(self.id, i, physicsClientId=self.client)[6] for i in self.joint_indices]

    @cached_property
    def _colors(self) -> dict[tuple[int, int], tuple[float, ...]]:
        seen: dict[int, int] = {}
        colors = {}
        for shape in pybullet.getVisualShapeData(self.id, physicsClientId=self.client):
            index = seen[shape[1]] = seen.get(shape[1], -1) + 1  # a link may have several shapes
            colors[shape[1], index] = shape[7]
        return colors

    def _change(self, link: int, **values: object) -> None:
        pybullet.changeDynamics(self.id, link, **values, physicsClientId=self.client)

    def _paint(self, link: int, shape: int, color: Sequence[float]) -> None:
        pybullet.changeVisualShape(self.id, link, shapeIndex=shape, rgbaColor=color, physicsClientId=self.client)

    def _link_index(self, link: str) -> int:
        if link not in self._links:  # checked first because links are read at every step
            base = f"only its base, {self.base_name!r}"
            check_name(link, self._links, f"{self.file.name} has no link", TaskError, none=base)
        return self._links[link]

    def _part_index(self, part: str) -> int:
        # A link's index, or -1 for the base, by its name.
        return -1 if part == self.base_name and part not in self._links else self._link_index(part)

    def _select_links(self, links: Sequence[str]) -> list[int]:
        return [self._part_index(link) for link in links] or list(range(-1, len(self._links)))

    def total_mass(self) -> float:
        return sum(dynamics.mass for dynamics in self._dynamics.values())

    def find_trunk(self) -> str | None:
        if not self.fixed:
            return self.base_name
        if not self._links:
            return None
        first = pybullet.getJointInfo(self.id, 0, physicsClientId=self.client)
        limited = 0 <= first[9] - first[8] < _RAIL  # without limits the lower limit is above the upper one
        if first[2] != pybullet.JOINT_PRISMATIC or limited:
            return None
        # PyBullet 3.2.7 crashes when it is asked for the collision shapes of a body of an MJCF file.
        drawn = {shape[1] for shape in pybullet.getVisualShapeData(self.id, physicsClientId=self.client)}
        return next((name for name, index in self._links.items() if index in drawn), None)

    def scale_mass(self, factor: float, links: Sequence[str] = ()) -> None:
        chosen, nominal = self._select_links(links), self._dynamics
        self._changed.add("_dynamics")
        for link in chosen:
            mass, _, inertia = nominal[link]
            self._change(link, mass=mass * factor, localInertiaDiagonal=[element * factor for element in inertia])

    def set_friction(self, friction: float, links: Sequence[str] = ()) -> None:
        chosen, _ = self._select_links(links), self._dynamics
        self._changed.add("_dynamics")
        for link in chosen:
            self._change(link, lateralFriction=friction)

    def set_contact_stiffness(self, stiffness: float, links: Sequence[str] = ()) -> None:
        self._changed.add("_contacts")
        engine = pybullet.getPhysicsEngineParameters(physicsClientId=self.client)
        # With this damping a physics step removes a fifth of the overlap, as in rigid contacts.
        damping = 4.0 * engine["fixedTimeStep"] / engine["numSubSteps"] * stiffness
        for link in self._select_links(links):
            self._change(link, contactStiffness=stiffness, contactDamping=damping)

    def scale_joint_damping(self, factor: float, joints: Sequence[str] = ()) -> None:
        nominal, chosen = self._damping, self.find_joints(joints)
        if not any(nominal[index] for index in chosen):
            raise TaskError(f"{self.file.name}: these joints have no damping to scale; use set_joint_damping")
        self._set_damping({index: factor * nominal[index] for index in chosen})

    def set_joint_damping(self, damping: float, joints: Sequence[str] = ()) -> None:
        self._set_damping(dict.fromkeys(self.find_joints(joints), damping))

    def _set_damping(self, values: dict[int, float]) -> None:
        _ = self._damping  # nominal values are read before the first change
        self._changed.add("_damping")
        for index, damping in values.items():
            self._change(self.joint_indices[index], jointDamping=damping)

    def set_color(self, rgb: Sequence[float], links: Sequence[str] = ()) -> None:
        chosen, nominal = self._select_links(links), self._colors
        self._changed.add("_colors")
        for (link, shape), color in nominal.items():
            if link in chosen:
                self._paint(link, shape, (*rgb, color[3]))

    def _mass_centre(self, link: int) -> tuple[float, ...]:
        # [m], world frame; `link` is an index, -1 the base.
        if link < 0:
            state = pybullet.getBasePositionAndOrientation(self.id, physicsClientId=self.client)
        else:
            state = pybullet.getLinkState(self.id, link, computeForwardKinematics=1, physicsClientId=self.client)
        return tuple(state[0])
