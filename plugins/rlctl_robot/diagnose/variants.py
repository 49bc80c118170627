"""Single changes of how an imported policy is deployed: what the file, or its reader, may have confused."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from rlctl.task.deployment import Deployment, ObservedPart
from rlctl.task.mujoco.robot import Robot
from rlctl_robot.diagnose.candidates import list_permutations

_FACTORS = (0.05, 0.1, 0.2, 0.25, 0.5, 2.0, 4.0, 5.0, 10.0, 20.0)
_ACTION_FACTORS = (0.25, 0.5, 2.0, 4.0)
_GAIN_FACTORS = (0.1, 0.5, 2.0, 10.0)
_RATES = (0.25, 0.5, 2.0, 4.0)
_SLOWEST = 0.1  # [s], between two actions
_LEG = re.compile(r"(?P<row>[FRHL])(?P<side>[LR])_|(?P<first>[LR])(?P<second>[FH])_")  # FL_hip, LF_HAA
_SIDE = re.compile(r"left|right|(?<![a-z])[lr](?=_)", re.IGNORECASE)
_SIGNED = ("gyroscope", "velocity", "gravity", "accelerometer", "joint_positions", "joint_velocities", "targets")
_UNITLESS = ("phase", "gravity", "anchor_orientation", "contacts")


@dataclasses.dataclass(frozen=True)
class Variant:
    """A deployment that differs from the file's in one way."""

    kind: str  # joint order, gains, scale, sign, default pose, frame, history, rate, parts
    text: str  # what is wrong in the file, if this one walks
    deployment: Deployment
    moves_world: bool = False
    """Whether the simulated robot differs, not only what the policy reads and sends."""

    def list_changes(self, deployment: Deployment) -> dict[str, Any]:
        """Return what differs from the file's deployment, as plain data by name."""
        before = deployment.model_dump(mode="json")
        after = self.deployment.model_dump(mode="json")
        return {name: value for name, value in after.items() if value != before[name]}


def list_variants(deployment: Deployment, robot: Robot) -> list[Variant]:
    """Return all single changes, without those that change nothing or are no deployment."""
    found: dict[str, Variant] = {}
    for variant in itertools.chain(
        _list_orders(deployment, robot),
        _list_gains(deployment, robot),
        _list_scales(deployment),
        _list_signs(deployment),
        _list_poses(deployment, robot),
        _list_frames(deployment),
        _list_histories(deployment),
        _list_rates(deployment),
        _list_parts(deployment),
    ):
        key = variant.deployment.model_dump_json()
        if key != deployment.model_dump_json():
            found.setdefault(key, variant)
    return list(found.values())


def _change(deployment: Deployment, **values: Any) -> Deployment:
    return Deployment(**{**deployment.model_dump(), **values})


def _list_joint_orders(deployment: Deployment, robot: Robot) -> Iterator[tuple[tuple[int, ...], str]]:
    """Yield orders of all joints that projects use, with what they are: joint k is the present one `order[k]`."""
    joints = list(deployment.joints)
    of_robot = {
        f"the order of {robot.path.name}": robot.joints,
        f"the order of the motors of {robot.path.name}": robot.motors,
        "Isaac Lab's order, by the distance from the base": robot.breadth_first,
    }
    for text, names in of_robot.items():
        own = [name for name in names if name in joints]
        if sorted(own) == sorted(joints):
            yield tuple(joints.index(name) for name in own), text
    yield tuple(sorted(range(len(joints)), key=lambda index: joints[index])), "alphabetical order"
    yield tuple(_exchange_sides(joints)), "left and right exchanged"
    front = [_exchange(name, "F", "R") if name[:1] in "FR" and name[1:2] in "LR" else name for name in joints]
    if sorted(front) == sorted(joints):
        yield tuple(joints.index(name) for name in front), "front and rear legs exchanged"
    for order, text in list_permutations(len(joints), joints).items():
        if not text.endswith("are swapped"):
            yield order, text.removeprefix("the elements are ").removeprefix("the joints are ")


def _exchange(name: str, one: str, other: str) -> str:
    return other + name[1:] if name.startswith(one) else one + name[1:]


@dataclasses.dataclass(frozen=True)
class _Place:
    """Where a joint is, as its name says it."""

    row: str  # of legs, `F` and `R`; empty for robots on two legs
    side: str  # `l` or `r`; empty in the middle
    kind: str  # the name without these


def _read_place(name: str) -> _Place:
    leg = _LEG.match(name)
    if leg is not None:
        row, side = leg["row"] or leg["second"], leg["side"] or leg["first"]
        return _Place(row, side.lower(), name[leg.end() :])
    side_name = _SIDE.search(name)
    if side_name is not None:
        return _Place("", side_name[0][0].lower(), name[: side_name.start()] + name[side_name.end() :])
    return _Place("", "", name)


def _exchange_sides(joints: Sequence[str]) -> list[int]:
    """Return the order with left and right exchanged, as far as names say what is left."""
    places = [_read_place(name) for name in joints]
    indices = {place: index for index, place in enumerate(places)}
    other_side = {"l": "r", "r": "l", "": ""}
    others = [dataclasses.replace(place, side=other_side[place.side]) for place in places]
    return [indices.get(other, index) for index, other in enumerate(others)]


def _list_groups(joints: Sequence[str]) -> dict[tuple[int, ...], str]:
    """Return the joints of one kind, with their text: of all legs, of one side, of one row."""
    places = [_read_place(name) for name in joints]
    groups: dict[tuple[int, ...], str] = {}
    for by in (("kind",), ("kind", "side"), ("kind", "row")):
        found: dict[tuple[str, ...], list[int]] = {}
        for index, place in enumerate(places):
            if place.side:
                found.setdefault(tuple(getattr(place, name) for name in by), []).append(index)
        for group in found.values():
            if len(group) > 1:
                groups[tuple(group)] = " and ".join(joints[index] for index in group)
    return groups


def _list_orders(deployment: Deployment, robot: Robot) -> Iterator[Variant]:
    joints = deployment.joints
    for order, text in _list_joint_orders(deployment, robot):
        names = tuple(joints[index] for index in order)
        what = f"the policy's joints are in another order: {text}"
        yield Variant("joint order", what, _change(deployment, joints=names), moves_world=True)
        moved = {
            name: tuple(values[index] for index in order)
            for name in ("default_positions", "action_scale", "stiffness", "damping", "max_torque", "armature")
            if (values := getattr(deployment, name))
        }
        yield Variant(
            "joint order",
            f"the policy's joints are in another order, default positions and gains fit their joints: {text}",
            _change(deployment, joints=names, **moved),
        )
    for one, other in itertools.combinations(range(len(joints)), 2):
        swapped = list(joints)
        swapped[one], swapped[other] = joints[other], joints[one]
        text = f"joints {joints[one]} and {joints[other]} are exchanged"
        yield Variant("joint order", text, _change(deployment, joints=tuple(swapped)))


def _list_gains(deployment: Deployment, robot: Robot) -> Iterator[Variant]:
    orders = dict(_list_joint_orders(deployment, robot))
    for order, text in orders.items():
        for chosen in (order, tuple(int(index) for index in np.argsort(order))):
            gains = {
                name: tuple(getattr(deployment, name)[index] for index in chosen) for name in ("stiffness", "damping")
            }
            what = f"stiffness and damping are in another order than the joints: {text}"
            yield Variant("gains", what, _change(deployment, **gains), moves_world=True)
    for factor in _GAIN_FACTORS:
        for names in (("stiffness", "damping"), ("stiffness",), ("damping",)):
            gains = {name: tuple(factor * value for value in getattr(deployment, name)) for name in names}
            what = f"{' and '.join(names)}: {1 / factor:g} times what the policy was trained with"
            yield Variant("gains", what, _change(deployment, **gains), moves_world=True)
    swapped = {"stiffness": deployment.damping, "damping": deployment.stiffness}
    yield Variant("gains", "stiffness and damping are exchanged", _change(deployment, **swapped), moves_world=True)


def _multiply(scale: Any, factor: Any) -> Any:
    product = np.asarray(scale, float) * factor
    return tuple(product.tolist()) if product.ndim else float(product)


def _replace_part(deployment: Deployment, kind: str, **values: Any) -> Deployment:
    parts = [
        ObservedPart(**{**part.model_dump(), **values}) if part.kind == kind else part
        for part in deployment.observations
    ]
    return _change(deployment, observations=[part.model_dump() for part in parts])


def _list_scales(deployment: Deployment) -> Iterator[Variant]:
    degree = math.pi / 180
    units = {
        degree: "is in degrees, the policy expects radians",
        1 / degree: "is in radians, the policy expects degrees",
    }
    for part in deployment.measured_parts:
        if part.kind in _UNITLESS:
            continue
        for factor in _FACTORS:
            text = f"{part.kind}: its scale is {1 / factor:g} times the policy's"
            yield Variant("scale", text, _replace_part(deployment, part.kind, scale=_multiply(part.scale, factor)))
        for factor, unit in units.items():
            changed = _replace_part(deployment, part.kind, scale=_multiply(part.scale, factor))
            yield Variant("scale", f"{part.kind} {unit}", changed)
    for factor in _ACTION_FACTORS:
        scale = tuple(factor * value for value in deployment.action_scale)
        text = f"the action's scale is {1 / factor:g} times the policy's"
        yield Variant("scale", text, _change(deployment, action_scale=scale))


def _list_signs(deployment: Deployment) -> Iterator[Variant]:
    for part in deployment.observations:
        if part.kind in _SIGNED:
            text = f"{part.kind} has the wrong sign"
            yield Variant("sign", text, _replace_part(deployment, part.kind, scale=_multiply(part.scale, -1.0)))
        if part.kind in ("gyroscope", "gravity", "velocity", "accelerometer", "command"):
            for element in range(3):
                signs = np.ones(3)
                signs[element] = -1.0
                changed = _replace_part(deployment, part.kind, scale=_multiply(part.scale, signs))
                yield Variant("sign", f"{part.kind}: element {element} has the wrong sign", changed)
    kinds: dict[str, Any] = {part.kind: part.scale for part in deployment.observations}
    for index, joint in enumerate(deployment.joints):
        changed = _reverse(deployment, kinds, [index])
        yield Variant("sign", f"joint {joint} turns the other way", changed)
    for group, text in _list_groups(deployment.joints).items():
        yield Variant("sign", f"joints {text} turn the other way", _reverse(deployment, kinds, group))
    yield Variant(
        "sign", "the actions have the wrong sign", _reverse_actions(deployment, range(len(deployment.joints)))
    )


def _reverse(deployment: Deployment, kinds: Mapping[str, Any], joints: Sequence[int]) -> Deployment:
    """Return the deployment with joints that turn the other way, in what is observed and commanded."""
    signs = np.ones(len(deployment.joints))
    signs[list(joints)] = -1.0
    changed = _reverse_actions(deployment, joints)
    for kind in ("joint_positions", "joint_velocities", "targets"):
        if kind in kinds:
            changed = _replace_part(changed, kind, scale=_multiply(kinds[kind], signs))
    return changed


def _reverse_actions(deployment: Deployment, joints: Sequence[int]) -> Deployment:
    scale = [-value if index in joints else value for index, value in enumerate(deployment.action_scale)]
    return _change(deployment, action_scale=scale)


def _list_poses(deployment: Deployment, robot: Robot) -> Iterator[Variant]:
    joints, default = deployment.joints, deployment.default_positions
    poses: dict[str, Sequence[float]] = {}
    if robot.pose:
        poses[f"those of keyframe {robot.keyframe!r} of {robot.path.name}"] = [
            robot.pose.get(name, 0.0) for name in joints
        ]
    poses["zeros"] = [0.0] * len(joints)
    poses["the negative ones"] = [-value for value in default]
    poses["in radians, the file's are in degrees"] = [math.radians(value) for value in default]
    for order, text in _list_joint_orders(deployment, robot):
        poses[f"in another order: {text}"] = [default[index] for index in order]
        poses[f"in another order, from: {text}"] = [default[int(index)] for index in np.argsort(order)]
    poses |= _copy_legs(joints, default)
    for text, pose in poses.items():
        changed = _change(deployment, default_positions=tuple(pose))
        yield Variant("default pose", f"the policy's default positions are {text}", changed, moves_world=True)
    for part in deployment.observations:
        if part.kind == "joint_positions":
            changed = _replace_part(deployment, part.kind, relative=not part.relative)
            what = "are angles themselves" if part.relative else "are from the default positions"
            yield Variant("default pose", f"the policy's joint positions {what}", changed, moves_world=True)


def _copy_legs(joints: Sequence[str], default: Sequence[float]) -> dict[str, Sequence[float]]:
    """Return poses in which one leg, or one side, has the positions of its counterpart, with text."""
    places, others = [_read_place(name) for name in joints], _exchange_sides(joints)
    poses: dict[str, Sequence[float]] = {}
    for row, side in dict.fromkeys((place.row, place.side) for place in places if place.side):
        pose = list(default)
        for index, place in enumerate(places):
            if (place.row, place.side) == (row, side):
                value = default[others[index]]
                is_mirrored = value * default[index] < 0
                pose[index] = -value if is_mirrored else value
        first = next(index for index, place in enumerate(places) if (place.row, place.side) == (row, side))
        poses[f"those of the other side, at {joints[first]} and the joints of its leg or side"] = pose
    return poses


def _list_frames(deployment: Deployment) -> Iterator[Variant]:
    for part in deployment.observations:
        if part.kind in ("gyroscope", "velocity"):
            frame = "world" if part.frame == "body" else "body"
            text = f"{part.kind} is in the {part.frame} frame, the policy expects the {frame} frame"
            yield Variant("frame", text, _replace_part(deployment, part.kind, frame=frame), moves_world=True)


def _list_histories(deployment: Deployment) -> Iterator[Variant]:
    if not deployment.history:
        return
    newest = not deployment.newest_first
    first = "newest" if newest else "oldest"
    yield Variant(
        "history", f"the policy's histories begin with the {first} value", _change(deployment, newest_first=newest)
    )
    lengths = {part.history for part in deployment.measured_parts}
    if len(lengths) == 1:
        order = "frames" if deployment.history_order == "terms" else "terms"
        has = "all parts of a step together" if order == "frames" else "all values of a part together"
        for both in (deployment.newest_first, newest):
            changed = _change(deployment, history_order=order, newest_first=both)
            begins = "" if both == deployment.newest_first else f", beginning with the {first}"
            yield Variant("history", f"the policy's histories have {has}{begins}", changed)


def _list_rates(deployment: Deployment) -> Iterator[Variant]:
    for factor in _RATES:
        control_dt = deployment.control_dt * factor
        if control_dt <= _SLOWEST:
            text = f"the policy acts every {control_dt:g} s, the file has {deployment.control_dt:g} s"
            yield Variant("rate", text, _change(deployment, control_dt=control_dt), moves_world=True)


def _list_parts(deployment: Deployment) -> Iterator[Variant]:
    """Yield orders of the observations in which two of one size are exchanged."""
    parts = list(deployment.observations)
    for one, other in itertools.combinations(range(len(parts)), 2):
        are_measured = "constant" not in (parts[one].kind, parts[other].kind)
        if are_measured and deployment.find_size(parts[one]) == deployment.find_size(parts[other]):
            swapped = list(parts)
            swapped[one], swapped[other] = parts[other], parts[one]
            text = f"the observations {parts[one].kind} and {parts[other].kind} are exchanged"
            yield Variant("parts", text, _change(deployment, observations=[part.model_dump() for part in swapped]))
