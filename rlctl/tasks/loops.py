"""Loops of links in a gripper: in the copy of a model its joints follow one of them instead.

Loops of light links that stiff constraints close need short physics steps and many iterations of the solver. Joints
that follow another one move the same way, and a few iterations hold them.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from rlctl.tasks.grippers import Gripper
from rlctl.tasks.linkage import Linkage

_STIFF = {"solref": "0.01 1", "solimp": "0.95 0.99 0.001"}


def replace_loops(files: dict[Path, bytes], model: Path, linkage: Linkage, gripper: Gripper) -> list[str]:
    """Let the joints of a gripper with loops follow its first driver; return a sentence if there were loops.

    Only MJCF files have loops.
    """
    if not linkage.list_loops() or model.suffix == ".urdf":
        return []
    root = ElementTree.fromstring(files[model])
    links = {link for joint in gripper.joints for link in linkage.list_links(joint)}
    names = [linkage.body.joint_names[joint] for joint in gripper.joints]
    removed = 0
    for equalities in root.iterfind("equality"):
        for equality in list(equalities):
            if links & set(_list_ends(root, equality)):
                equalities.remove(equality)
                removed += 1
            elif equality.get("joint1") in names:
                equalities.remove(equality)
    if not removed:
        return []
    driver = gripper.drivers[0]
    followers = [joint for joint in gripper.joints if joint != driver]
    equalities = ElementTree.SubElement(root, "equality")
    for joint in followers:
        ends = {"joint1": linkage.body.joint_names[joint], "joint2": linkage.body.joint_names[driver]}
        polynomial = " ".join(f"{value:.6g}" for value in _fit(linkage, gripper, joint, driver))
        ElementTree.SubElement(equalities, "joint", {**ends, "polycoef": polynomial, **_STIFF})
    files[model] = ElementTree.tostring(root)
    return [
        f"The links of its gripper form loops: in the copy {len(followers)} joints follow "
        f"{linkage.body.joint_names[driver]} instead"
    ]


def write_armature(files: dict[Path, bytes], model: Path, armature: Mapping[str, float]) -> None:
    """Write the armature of joints into the copy of a model [kg m^2 or kg].

    MuJoCo makes an equality as stiff as suits the inertia of its joints when it compiles the model.
    """
    root = ElementTree.fromstring(files[model])
    for joint in root.iterfind("worldbody//joint"):
        name = joint.get("name", "")
        if name in armature:
            joint.set("armature", f"{armature[name]:.3g}")
    files[model] = ElementTree.tostring(root)


def _list_ends(root: ElementTree.Element, equality: ElementTree.Element) -> Iterator[str]:
    """Return the names of the bodies that an equality connects."""
    for number in (1, 2):
        yield equality.get(f"body{number}", "")
        site = equality.get(f"site{number}")
        for body in root.iter("body"):
            if site is not None and any(own.get("name") == site for own in body.findall("site")):
                yield body.get("name", "")


def _fit(linkage: Linkage, gripper: Gripper, joint: int, driver: int) -> list[float]:
    """Return the coefficients, the constant first, of a joint's way by that of the driver, from their references."""
    poses = np.array([gripper.open, gripper.holding, gripper.closed])
    poses -= linkage.model.qpos0[linkage.places]
    coefficients = np.polyfit(poses[:, driver], poses[:, joint], 2)[::-1]
    return [*coefficients.tolist(), 0.0, 0.0]
