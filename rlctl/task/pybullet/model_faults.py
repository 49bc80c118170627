"""Finds what a URDF gets wrong without an error: impossible masses and inertias, texts for numbers, degrees."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator

import numpy as np

from rlctl.task.body import Body
from rlctl.task.pybullet.body import PybulletBody
from rlctl.task.pybullet.library import pybullet

_ROUNDING = 1.01  # of values written with a few digits
_NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"
_NUMERIC = ("mass", "inertia", "origin", "axis", "limit", "box", "cylinder", "sphere")  # elements, all attributes
_DEGREES = (30.0, 360.0)  # a motor before a gear may turn 30 rad; more than 360 stands for no limit


def find_model_faults(body: Body) -> list[str]:
    """Return a line for every link and joint of a URDF body that PyBullet reads without an error, but wrongly.

    A link without `<inertial>` weighs 1 kg in PyBullet. Principal moments [kg m^2] are positive, none exceeds the sum
    of the others, and none exceeds mass x size^2, where size [m] is the diagonal of the link's collision shape.
    """
    if not isinstance(body, PybulletBody) or body.file.suffix != ".urdf":
        return []
    try:
        root = ElementTree.fromstring(body.file.read_bytes().strip())
    except (ElementTree.ParseError, LookupError, ValueError):  # LookupError and ValueError: an unknown encoding
        return []  # PyBullet reads more than XML allows
    faults = [*_find_faults(body, root), *_find_joint_faults(root)]
    return [f"{body.file.name}, {place}: {fault}" for place, fault in faults]


def _find_faults(body: PybulletBody, root: ElementTree.Element) -> Iterator[tuple[str, str]]:
    for link in root.findall("link"):
        name = link.get("name", "")
        place = f"link {name!r}"
        if fault := _find_text(link, body.inertia_from_file):
            yield place, fault
            continue
        index = -1 if name == body.base_name else body._links.get(name)
        if index is None or (index == -1 and body.fixed):
            continue  # merged with its parent, or held by the world: its mass is not used
        inertial = link.find("inertial")
        mass = None if inertial is None else inertial.find("mass")
        if mass is not None and float(mass.get("value", 0)) < 0:
            yield place, f"a mass of {mass.get('value')} kg."
        # Frames of a gram with a rounded-up inertia are common and harmless: they keep the solver stable.
        if body._dynamics[index].mass <= 0.01 * body.total_mass():
            continue
        if inertial is None or mass is None:
            yield place, "no <inertial>, so PyBullet gives it a mass of 1 kg. Write its mass and inertia."
        elif body.inertia_from_file and (fault := _judge_inertia(body, index, inertial)):
            yield place, fault


def _find_joint_faults(root: ElementTree.Element) -> Iterator[tuple[str, str]]:
    for joint in root.findall("joint"):
        limit, fault = joint.find("limit"), _find_text(joint)
        if not fault and limit is not None and joint.get("type") == "revolute":
            lower, upper = (float(limit.get(name, 0)) for name in ("lower", "upper"))
            if _DEGREES[0] <= max(-lower, upper) <= _DEGREES[1]:
                fault = f"limits of {lower:g} and {upper:g} rad. Are these degrees?"
        if fault:
            yield f"joint {joint.get('name', '')!r}", fault


def _find_text(owner: ElementTree.Element, inertia_used: bool = True) -> str:
    """Return what is wrong with the first value that is not a number, or numbers separated by spaces."""
    for element in owner.iter():
        for name, value in element.items() if element.tag in _NUMERIC else ():
            is_used, numbers = inertia_used or element.tag != "inertia", value.replace(", ", " ").split()
            if is_used and not (numbers and all(re.fullmatch(_NUMBER, number) for number in numbers)):
                return f"{element.tag} {name}={value!r} is not a number; PyBullet reads its first digits, or 0."
    return ""


def _judge_inertia(body: PybulletBody, index: int, inertial: ElementTree.Element) -> str:
    mass = float(inertial.find("mass").get("value", 0))  # type: ignore[union-attr]
    element = inertial.find("inertia")
    if mass == 0 or element is None:
        return ""
    ixx, iyy, izz, ixy, ixz, iyz = (float(element.get(name, 0)) for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
    moments = np.linalg.eigvalsh([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])  # in ascending order
    written = ", ".join(f"{moment:.3g}" for moment in moments)
    if moments[0] <= 0:
        return f"principal moments {written} kg m^2 are not all above 0, as those of a link of {mass:g} kg are."
    if moments[2] > _ROUNDING * (moments[0] + moments[1]):
        return (
            f"principal moments {written} kg m^2: the largest exceeds the sum of the others, which no solid body has."
        )
    if not pybullet.getCollisionShapeData(body.id, index, physicsClientId=body.client):
        return ""
    low, high = pybullet.getAABB(body.id, index, physicsClientId=body.client)
    size = float(np.linalg.norm(np.subtract(high, low)))
    most = mass * size**2
    if moments[2] > _ROUNDING * most:
        return (
            f"a moment of {moments[2]:.3g} kg m^2 is more than {mass:g} kg within {size:.2g} m can have "
            f"({most:.2g}). Correct the file, or load it with inertia='shape'."
        )
    return ""
