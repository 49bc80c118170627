"""Finds masses and inertias in a URDF that are physically impossible."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator

import numpy as np

from rlctl.task.body import Body
from rlctl.task.bullet import pybullet

_ROUNDING = 1.01  # of values written with a few digits
_NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"


def find_inertia_faults(body: Body) -> list[str]:
    """Return a line for every link of a URDF body whose mass or inertia is missing or impossible.

    A link without `<inertial>` weighs 1 kg in PyBullet. Principal moments [kg m^2] are positive, none exceeds the sum
    of the others, and none exceeds mass x size^2, where size [m] is the diagonal of the link's collision shape.
    """
    if body.file.suffix != ".urdf":
        return []
    try:
        root = ElementTree.fromstring(body.file.read_bytes().strip())
    except (ElementTree.ParseError, LookupError, ValueError):  # LookupError and ValueError: an unknown encoding
        return []  # PyBullet reads more than XML allows
    return [f"{body.file.name}, link {name!r}: {fault}" for name, fault in _find_faults(body, root)]


def _find_faults(body: Body, root: ElementTree.Element) -> Iterator[tuple[str, str]]:
    for link in root.findall("link"):
        name = link.get("name", "")
        index = -1 if name == body.base_name else body._links.get(name)
        if index is None or (index == -1 and body.fixed):
            continue  # merged with its parent, or held by the world: its mass is not used
        inertial = link.find("inertial")
        if inertial is not None and (fault := _find_bad_number(inertial, body.inertia_from_file)):
            yield name, fault
            continue
        # Frames of a gram with a rounded-up inertia are common and harmless: they keep the solver stable.
        if body._dynamics[index].mass <= 0.01 * body.total_mass():
            continue
        if inertial is None or inertial.find("mass") is None:
            yield name, "no <inertial>, so PyBullet gives it a mass of 1 kg. Write its mass and inertia."
        elif body.inertia_from_file and (fault := _judge_inertia(body, index, inertial)):
            yield name, fault


def _find_bad_number(inertial: ElementTree.Element, inertia_used: bool) -> str:
    """Return what is wrong with the first value that is not a number, or with a negative mass."""
    for element in inertial.findall("mass") + inertial.findall("inertia") * inertia_used:
        for name, value in element.items():
            if not re.fullmatch(_NUMBER, value.strip()):
                return f"{element.tag} {name}={value!r} is not a number; PyBullet reads its first digits, or 0."
            if element.tag == "mass" and float(value) < 0:
                return f"a mass of {float(value):g} kg."
    return ""


def _judge_inertia(body: Body, index: int, inertial: ElementTree.Element) -> str:
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
