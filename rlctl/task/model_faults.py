"""Finds what a URDF gets wrong without an error: impossible masses and inertias, texts for numbers, degrees."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from rlctl.task.body import Body
from rlctl.task.pybullet.body import PybulletBody
from rlctl.task.pybullet.library import pybullet
from rlctl.task.urdf import FRAME_MASS, GUESSED_MASS, Urdf, read_mass, read_products, read_urdf

_ROUNDING = 1.01  # of values written with a few digits
_LIGHT = 0.01  # of the mass of all links
_NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"
_NUMERIC = ("mass", "inertia", "origin", "axis", "limit", "box", "cylinder", "sphere")  # elements, all attributes
_DEGREES = (30.0, 360.0)  # a motor before a gear may turn 30 rad; more than 360 stands for no limit
_MOST_NAMES = 4


def find_model_faults(body: Body) -> list[str]:
    """Return a line for every link and joint of a URDF body that engines read without an error, but wrongly.

    Where `rlctl.task.urdf` replaces a value, the line has the new one. Principal moments [kg m^2] are positive, none
    exceeds the sum of the others, and, in PyBullet, none exceeds mass x size^2, where size [m] is the diagonal of the
    link's collision shape.
    """
    if body.file.suffix != ".urdf" or not body.file.is_file():
        return []
    urdf = read_urdf(body.file, fixed=body.fixed, inertia_from_file=body.inertia_from_file)
    if urdf.root is None:
        return []
    links = _group(_find_faults(body, urdf, urdf.root))
    joints = _group(_find_joint_faults(urdf.root))
    lines = [f"{_list_names('link', names)}: {fault}" for fault, names in links.items()]
    lines += [f"{_list_names('joint', names)}: {fault}" for fault, names in joints.items()]
    return [f"{body.file.name}, {line}" for line in lines]


def _group(faults: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Return the names by their fault: links with one copied inertia have the same."""
    names: dict[str, list[str]] = {}
    for name, fault in faults:
        names.setdefault(fault, []).append(name)
    return names


def _list_names(noun: str, names: Sequence[str]) -> str:
    shown = ", ".join(map(repr, names[:_MOST_NAMES]))
    if len(names) == 1:
        return f"{noun} {shown}"
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f"{noun}s {shown}{more}"


def find_frames(body: Body) -> str:
    """Return a line about the links of a URDF body without `<inertial>` that are frames; empty if there are none."""
    if body.file.suffix != ".urdf" or not body.file.is_file():
        return ""
    names = read_urdf(body.file, fixed=body.fixed).frames
    if not names:
        return ""
    shown = _list_names("", names).removeprefix("s").lstrip()
    return f"{body.file.name}: links without <inertial> weigh {FRAME_MASS * 1e6:g} mg: {shown}"


def _find_faults(body: Body, urdf: Urdf, root: ElementTree.Element) -> Iterator[tuple[str, str]]:
    for name, mesh in urdf.undrawn.items():
        yield name, f"its visual mesh {mesh!r} is missing. Its other shapes are drawn."
    for name, count in urdf.recolored.items():
        yield name, f"a shape with {count} materials. The first is drawn."
    total = sum(max(0.0, read_mass(link) or 0.0) for link in root.findall("link"))
    for link in root.findall("link"):
        name, mass = link.get("name", ""), read_mass(link) or 0.0
        if fault := _find_text(link, body.inertia_from_file):
            yield name, fault
        elif name == body.base_name and body.fixed:
            continue  # held by the world: its mass is not used
        elif mass < 0:
            yield name, f"a mass of {mass:g} kg."
        elif name in urdf.guessed:
            yield name, f"no <inertial>, so it weighs {GUESSED_MASS:g} kg. Write its mass and inertia."
        # Frames of a gram with a rounded-up inertia are common and harmless: they keep the solver stable.
        elif mass > _LIGHT * total and body.inertia_from_file and (fault := _judge_inertia(body, urdf, link, mass)):
            yield name, fault


def _find_joint_faults(root: ElementTree.Element) -> Iterator[tuple[str, str]]:
    for joint in root.findall("joint"):
        limit, fault = joint.find("limit"), _find_text(joint)
        if not fault and limit is not None and joint.get("type") in ("revolute", "prismatic"):
            lower, upper = (float(limit.get(name, 0)) for name in ("lower", "upper"))
            rotates = joint.get("type") == "revolute"
            unit = "rad" if rotates else "m"
            if lower > upper:
                fault = f"a lower limit of {lower:g} {unit}, above the upper one of {upper:g}: so it has no limits."
            elif rotates and _DEGREES[0] <= max(-lower, upper) <= _DEGREES[1]:
                fault = f"limits of {lower:g} and {upper:g} rad. Are these degrees?"
        if fault:
            yield joint.get("name", ""), fault


def _find_text(owner: ElementTree.Element, inertia_used: bool = True) -> str:
    """Return what is wrong with the first value that is not a number, or numbers separated by spaces."""
    for element in owner.iter():
        for name, value in element.items() if element.tag in _NUMERIC else ():
            is_used, numbers = inertia_used or element.tag != "inertia", value.replace(", ", " ").split()
            if is_used and not (numbers and all(re.fullmatch(_NUMBER, number) for number in numbers)):
                return f"{element.tag} {name}={value!r} is not a number; PyBullet reads its first digits, or 0."
    return ""


def _judge_inertia(body: Body, urdf: Urdf, link: ElementTree.Element, mass: float) -> str:
    name, matrix = link.get("name", ""), read_products(link)
    if matrix is None:
        return ""
    if name in urdf.raised:
        before, after = (_list_numbers(moments) for moments in (urdf.impossible[name], urdf.raised[name]))
        if urdf.impossible[name][0] <= 0:
            why = f"not all above 0, as those of a link of {mass:g} kg are"
        else:
            why = "the largest exceeds the sum of the others, which no solid body has"
        return f"principal moments {before} kg m^2: {why}. It has {after} instead."
    size = _measure_size(body, name)
    moment, most = float(np.linalg.eigvalsh(matrix)[2]), mass * size**2
    if size and moment > _ROUNDING * most:
        return (
            f"a moment of {moment:.3g} kg m^2 is more than {mass:g} kg within {size:.2g} m can have "
            f"({most:.2g}). Correct the file, or load it with inertia='shape'."
        )
    return ""


def _list_numbers(numbers: np.ndarray) -> str:
    return ", ".join(f"{number:.3g}" for number in numbers)


def _measure_size(body: Body, link: str) -> float:
    """Return the diagonal of a link's collision shape [m]; 0 if that is unknown."""
    index = -1 if link == body.base_name else getattr(body, "_links", {}).get(link)
    if not isinstance(body, PybulletBody) or index is None:
        return 0.0
    if not pybullet.getCollisionShapeData(body.id, index, physicsClientId=body.client):
        return 0.0
    low, high = pybullet.getAABB(body.id, index, physicsClientId=body.client)
    return float(np.linalg.norm(np.subtract(high, low)))
