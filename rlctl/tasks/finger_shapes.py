"""Whether a gripper's collision shapes can hold a block, and boxes instead of those that cannot.

MuJoCo collides with hulls: that of a jaw may fill the space between the fingers.
"""

from __future__ import annotations

import dataclasses
import itertools
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.task.rotations import roll_pitch_yaw
from rlctl.tasks.grippers import Gripper
from rlctl.tasks.linkage import Linkage
from rlctl.tasks.shapes import Array
from rlctl.tasks.surfaces import Surfaces

_BLOCK = "block that is held"
_FAR = 0.2  # [m]
_DEEP, _APART = 1.5e-3, 3e-3  # [m], by which a shape may be in an open gripper's block, or apart from a held one
_THINNEST = 1e-3  # [m], of a box
_OVERLAP = 1e-3  # [m], of the boxes of neighbouring slices


@dataclasses.dataclass(frozen=True)
class FingerBox:
    """A box in the frame of a link."""

    position: Array  # [m]
    quaternion: Array  # w, x, y, z
    half: Array  # [m]


def find_unfit(path: Path, linkage: Linkage, gripper: Gripper) -> list[str]:
    """Return the fingers' links whose collision shapes are in a block between the open fingers, or do not touch it."""
    probe = _Probe(path, linkage, gripper)
    unfit = {link for link, distance in probe.measure(gripper.open, gripper.point).items() if distance < -_DEEP}
    held = probe.measure(gripper.holding, gripper.held_point)
    for links in gripper.fingers:
        known = [link for link in links if link in held]
        nearest = min((held[link] for link in known), default=np.inf)
        if nearest > _APART:
            unfit |= set(links)
        unfit |= {link for link in known if held[link] < -_APART}
    return [link for links in gripper.fingers for link in links if link in unfit]


class _Probe:
    """The collision shapes as a task has them, and a block that is put between the fingers."""

    def __init__(self, path: Path, linkage: Linkage, gripper: Gripper) -> None:
        import mujoco

        from rlctl.task.mujoco.files import is_colliding, read_model_file

        self._mujoco, self._linkage, self._gripper = mujoco, linkage, gripper
        spec = read_model_file(path, fixed=True).spec
        geoms = [(number, geom.parent.name) for number, geom in enumerate(spec.geoms) if is_colliding(geom)]
        for number, geom in enumerate(spec.geoms):
            geom.name = f"geom {number}"
        block = spec.worldbody.add_body(name=_BLOCK, mocap=True)
        half = [gripper.width / 2, gripper.width / 2, gripper.height / 2]
        block.add_geom(name=_BLOCK, type=mujoco.mjtGeom.mjGEOM_BOX, size=half)
        self._model: Any = spec.compile()
        self._data: Any = mujoco.MjData(self._model)
        links = {link for fingers in gripper.fingers for link in fingers} | {gripper.palm}
        self._geoms = [(self._model.geom(f"geom {number}").id, link) for number, link in geoms if link in links]
        names = linkage.body.joint_names
        self._places = [int(self._model.jnt_qposadr[self._model.joint(name).id]) for name in names]

    def measure(self, positions: Array, point: Array) -> dict[str, float]:
        """Return the distances of links to a block at `point` of the palm [m], negative where they overlap."""
        mujoco, data = self._mujoco, self._data
        self._linkage.place(positions)
        data.qpos[self._places] = positions
        mujoco.mj_kinematics(self._model, data)
        number = self._model.body(self._gripper.palm).id
        palm = data.xmat[number].reshape(3, 3)
        data.mocap_pos[0] = data.xpos[number] + palm @ point
        mujoco.mju_mat2Quat(data.mocap_quat[0], (palm @ self._gripper.frame).ravel())
        mujoco.mj_kinematics(self._model, data)
        block, ends = self._model.geom(_BLOCK).id, np.zeros(6)
        nearest: dict[str, float] = {}
        for geom, link in self._geoms:
            distance = float(mujoco.mj_geomDistance(self._model, data, geom, block, _FAR, ends))
            nearest[link] = min(distance, nearest.get(link, np.inf))
        return nearest


def fit_boxes(
    links: Sequence[str], linkage: Linkage, surfaces: Surfaces, gripper: Gripper
) -> dict[str, list[FingerBox]]:
    """Return boxes around slices of links, across the direction of the fingers, while these hold a block.

    Slices are thin next to the block. What of a palm is on both sides of the block gets a box on each side.
    """
    linkage.place(gripper.holding)
    palm, origin = linkage.frame(gripper.palm)
    frame = palm @ gripper.frame
    middle = origin + palm @ gripper.held_point
    fitted = {}
    for link in links:
        turn, place = linkage.frame(link)
        points = (surfaces.list_points(link) @ turn.T + place - middle) @ frame
        boxes = []
        for low, high in _slice(points, gripper):
            boxes.append(_make_box(low, high, turn.T @ frame, turn.T @ (middle - place)))
        if boxes:
            fitted[link] = boxes
    return fitted


def _slice(points: Array, gripper: Gripper) -> list[tuple[Array, Array]]:
    """Return the lower and upper corners of boxes around points, in the gripper's frame from the block's middle."""
    if not len(points):
        return []
    lowest, tip, fine = float(points[:, 2].min()), float(points[:, 2].max()), gripper.height / 3
    above = -0.75 * gripper.height  # where the block ends, towards the palm
    edges = [tip]
    while edges[-1] > max(above, lowest):
        edges.append(max(edges[-1] - fine, lowest))
    edges += np.linspace(edges[-1], lowest, 4)[1:].tolist() if edges[-1] > lowest + fine else []
    corners = []
    for top, bottom in itertools.pairwise(edges):
        layer = points[(points[:, 2] <= top + _OVERLAP) & (points[:, 2] >= bottom - _OVERLAP)]
        sides = [layer[layer[:, 0] > 0], layer[layer[:, 0] <= 0]] if top > above else [layer]
        for side in sides:
            if len(side) > 3:
                low, high = side.min(axis=0), side.max(axis=0)
                low[2], high[2] = max(low[2], bottom), min(high[2], top)
                corners.append((low, high))
    return corners


def _make_box(low: Array, high: Array, frame: Array, middle: Array) -> FingerBox:
    import mujoco

    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(frame).ravel())
    half = np.maximum((high - low) / 2, _THINNEST / 2)
    return FingerBox(middle + frame @ ((low + high) / 2), quaternion, half)


def replace_shapes(files: dict[Path, bytes], model: Path, boxes: Mapping[str, Sequence[FingerBox]]) -> None:
    """Replace the collision shapes of links in the copy of a model by boxes."""
    root = ElementTree.fromstring(files[model])
    if model.suffix == ".urdf":
        for link in root.findall("link"):
            if link.get("name") in boxes:
                _replace_in_urdf(link, boxes[link.get("name", "")])
    else:
        for body in root.iter("body"):
            if body.get("name") in boxes:
                _replace_in_mjcf(body, boxes[body.get("name", "")])
    files[model] = ElementTree.tostring(root)


def _replace_in_urdf(link: ElementTree.Element, boxes: Sequence[FingerBox]) -> None:
    for shape in link.findall("collision"):
        link.remove(shape)
    for box in boxes:
        angles = roll_pitch_yaw(box.quaternion[[1, 2, 3, 0]].tolist())
        shape = ElementTree.SubElement(link, "collision")
        ElementTree.SubElement(shape, "origin", xyz=_write(box.position), rpy=_write(angles))
        ElementTree.SubElement(ElementTree.SubElement(shape, "geometry"), "box", size=_write(2 * box.half))


def _replace_in_mjcf(body: ElementTree.Element, boxes: Sequence[FingerBox]) -> None:
    for geom in body.findall("geom"):
        geom.attrib |= {"contype": "0", "conaffinity": "0"}
    for box in boxes:
        place = {"pos": _write(box.position), "quat": _write(box.quaternion), "size": _write(box.half)}
        masks = {"contype": "1", "conaffinity": "1", "group": "3", "mass": "0"}
        ElementTree.SubElement(body, "geom", {"type": "box", **place, **masks})


def _write(values: Any) -> str:
    return " ".join(f"{value:.5g}" for value in values)
