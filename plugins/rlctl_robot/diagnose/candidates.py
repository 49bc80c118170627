"""The mistakes that are searched for in each observation and in the actions: each a `Correction`."""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from rlctl.environments.info import EnvInfo
from rlctl.limits.observation import find_command_ranges
from rlctl.policy.layers import Normalize
from rlctl_robot.diagnose.correction import EVERYTHING, JOINTS, Correction, Kind
from rlctl_robot.diagnose.signals import ACTIONS, MAX_DELAY, Array

_DEGREE = math.pi / 180
_RPM = 2 * math.pi / 60
_DEGREES = (_DEGREE, "is in degrees, the policy expects radians")
_RADIANS = (1 / _DEGREE, "is in radians, the policy expects degrees")
_MILLI = (1e-3, "is in millimetres (or another unit 1,000 times smaller), the policy expects metres")
_CENTI = (1e-2, "is 100 times too large, such as centimetres for metres")
_UNITS_OF: dict[str, tuple[tuple[float, str], ...]] = {
    "rad": (_DEGREES, (2 * math.pi, "is in turns, the policy expects radians")),
    "deg": (_RADIANS,),
    "rad/s": (
        (_DEGREE, "is in degrees per second, the policy expects radians per second"),
        (2 * math.pi, "is in turns per second, the policy expects radians per second"),
        (_RPM, "is in turns per minute, the policy expects radians per second"),
    ),
    "deg/s": ((1 / _DEGREE, "is in radians per second, the policy expects degrees per second"),),
    "m": (
        (1e-3, "is in millimetres, the policy expects metres"),
        (1e-2, "is in centimetres, the policy expects metres"),
    ),
    "m/s": (
        (1e-3, "is in millimetres per second, the policy expects metres per second"),
        (1e-2, "is in centimetres per second, the policy expects metres per second"),
        (1 / 3.6, "is in kilometres per hour, the policy expects metres per second"),
    ),
}
"""Factors that a program confuses, by the unit of the policy."""
_ANY_UNITS = (_DEGREES, _RADIANS, _MILLI, (1e3, "is 1,000 times too small"), _CENTI)  # where the unit is unknown
_FACTORS = (0.1, 0.25, 0.5, 2.0, 4.0, 10.0)  # of a gain that is wrong
_MOST_BLOCKS = 4  # all orders of so many blocks, such as legs, are tried
FROM_W_FIRST = (1, 2, 3, 0)
"""Elements of a quaternion (w, x, y, z) in the order x, y, z, w."""
_QUATERNION_ORDERS = (
    (FROM_W_FIRST, "the quaternion is in the order w, x, y, z, the policy expects x, y, z, w"),
    ((3, 0, 1, 2), "the quaternion is in the order x, y, z, w, the policy expects w, x, y, z"),
)
CONJUGATE = (-1.0, -1.0, -1.0, 1.0)
"""Factors of the inverse of a quaternion (x, y, z, w)."""
_CONJUGATES = (CONJUGATE, (1.0, -1.0, -1.0, -1.0))


@dataclasses.dataclass(frozen=True, eq=False)
class TermStatistics:
    """Mean and standard deviation of the elements of an observation or of the actions in simulation."""

    mean: Array
    std: Array
    is_quaternion: bool = False


def list_candidates(
    info: EnvInfo, statistics: Mapping[str, TermStatistics], normalize: Normalize | None = None
) -> list[Correction]:
    """Return all single mistakes of the observations and of the actions; `normalize` is the policy's."""
    found = [] if normalize is None else [make_normalised(normalize)]
    slices = {name: slice(0, len(values.mean)) for name, values in statistics.items()}
    # The program sets them itself.
    commands = {"command", *find_command_ranges(info, slices), *_list_clips(info)}
    for name, values in statistics.items():
        if name in commands:
            continue
        found += _list_of_term(name, values, info, statistics)
    return found


def _list_clips(info: EnvInfo) -> list[str]:
    """Return the terms that are what a clip wants, of which nothing is measured."""
    return [name for name, term in info.observation_terms.items() if term.kind == "playback" and not term.quantity]


def _list_of_term(
    name: str, values: TermStatistics, info: EnvInfo, statistics: Mapping[str, TermStatistics]
) -> Iterator[Correction]:
    size = len(values.mean)
    joints = list(info.joints.names) if info.joints is not None and len(info.joints.names) == size else []
    yield from _list_orders(name, size, joints)
    yield from _list_signs(name, size)
    yield from _list_units(name, size, info)
    yield from _list_factors(name, size)
    yield from _list_raw(name, values, joints, info)
    for delay in range(1, MAX_DELAY + 1):
        late = f"{delay} control step{'s' if delay > 1 else ''}"
        text = f"take effect {late} late" if name == ACTIONS else f"is {late} late"
        yield Correction(name, "delay", text, delay=delay)
    yield from _list_default_poses(name, size, info)
    if name == ACTIONS:
        return
    if values.is_quaternion:
        for order, text in _QUATERNION_ORDERS:
            yield Correction(name, "order", text, order=order)
        for factor in _CONJUGATES:
            yield Correction(name, "sign", "the quaternion is the conjugate (the inverse rotation)", factor=factor)
    if size == 3:
        yield from _list_frames(name, info, statistics)


def list_permutations(size: int, joints: Sequence[str]) -> dict[tuple[int, ...], str]:
    """Return orders that robots' programs confuse, with what is wrong: corrected = logged[order]."""
    found: dict[tuple[int, ...], str] = {}

    def add(order: Sequence[int], text: str) -> None:
        if list(order) != list(range(size)):
            found.setdefault(tuple(order), text)

    for one, other in itertools.combinations(range(size), 2):
        order = list(range(size))
        order[one], order[other] = other, one
        add(order, f"elements {one} and {other} are swapped")
    if joints:
        by_name = sorted(range(size), key=lambda index: joints[index])  # logged[k] is of joint by_name[k]
        add([int(index) for index in np.argsort(by_name)], "the joints are in alphabetical order")
    add(list(range(size))[::-1], "the elements are in reverse order")
    if size == 3:
        for triple in itertools.permutations(range(3)):
            add(triple, f"the elements are in the order {_inverse_text(triple)}")
    for columns in (columns for columns in range(2, size) if size % columns == 0):
        by_kind = np.argsort(np.arange(size).reshape(-1, columns).T.ravel())
        add(
            by_kind.tolist(),
            f"the elements are grouped by kind, {size // columns} of each, instead of {columns} together",
        )
        if (blocks := size // columns) <= _MOST_BLOCKS and columns > 1:
            for places in itertools.permutations(range(blocks)):
                blockwise = np.arange(size).reshape(blocks, columns)[list(places)].ravel()
                add(blockwise.tolist(), f"groups of {columns} elements are in the order {_inverse_text(places)}")
    for step in range(1, size):
        add(np.roll(np.arange(size), step).tolist(), f"the elements are shifted by {step} places")
    return found


def _inverse_text(order: Sequence[int]) -> str:
    return ", ".join(str(index) for index in np.argsort(order))


def _list_orders(name: str, size: int, joints: Sequence[str]) -> Iterator[Correction]:
    for order, text in list_permutations(size, joints).items():
        yield Correction(name, "order", text, order=order)


def _list_raw(name: str, values: TermStatistics, joints: Sequence[str], info: EnvInfo) -> Iterator[Correction]:
    """Yield mistakes of the angles that a program measures or commands, of which the policy's differ by the stance.

    A program confuses its own angles: it takes the stance off afterwards, and adds it before. Of angles without a
    stance, and of joints with equal default positions, these are the mistakes of the policy's values.
    """
    stance = find_stance(name, values, info)
    if stance is None:
        return
    size = len(values.mean)
    what = "among the joints' targets" if name == ACTIONS else "before the stance is subtracted"
    mistakes: list[Correction] = [*_list_orders(name, size, joints)]
    if name != ACTIONS:
        mistakes += [*_list_signs(name, size), *_list_units(name, size, info)]
    for one in mistakes:
        order = one.order or tuple(range(size))
        factor = one.factor or (1.0,) * size
        raw = _make_part(name, values, info, one.kind, order, factor)
        if raw.offset or not np.allclose(raw.factor, factor):
            yield dataclasses.replace(raw, text=f"{one.text}, {what}")


def list_joint_mistakes(info: EnvInfo, statistics: Mapping[str, TermStatistics]) -> list[Correction]:
    """Return mistakes of the joints' driver: it exchanges or reverses all quantities of a joint together.

    A program confuses its own angles, from which the policy's differ by the stance, or the policy's elements.
    """
    joints, size = info.joints, len(statistics[ACTIONS].mean)
    quantities = [name for name in statistics if is_of_joints(name, statistics[name], info)]
    if joints is None or len(joints.names) != size or not quantities:
        return []
    found = []
    names, straight = list(joints.names), tuple(range(size))
    terms = [*quantities, ACTIONS]
    where = f" in {', '.join(quantities)} and {ACTIONS}"
    orders = {order: _name_swapped(order, names) or text for order, text in list_permutations(size, names).items()}
    signs = {one.factor: one.text for one in _list_signs(JOINTS, size)} if size > 1 else {}
    named = {factor: f"{text}{_name_reversed(factor, names)}" for factor, text in signs.items()}
    mistakes: list[tuple[Kind, tuple[int, ...], tuple[float, ...], str]] = [
        *(("order", order, (1.0,) * size, text) for order, text in orders.items()),
        *(("sign", straight, factor, text) for factor, text in named.items()),
    ]
    for kind, order, factor, text in mistakes:
        of_angles = tuple(_make_part(name, statistics[name], info, kind, order, factor) for name in terms)
        plain = tuple(Correction(name, kind, text, order, factor) for name in terms)
        if any(one.offset for one in of_angles):
            angles = f"{text}{where}, before the stance is subtracted"
            found.append(Correction(JOINTS, kind, angles, parts=of_angles))
        found.append(Correction(JOINTS, kind, f"{text}{where}", parts=plain))
    return found


def list_joint_orders(
    info: EnvInfo, statistics: Mapping[str, TermStatistics], candidates: Sequence[Correction]
) -> list[Correction]:
    """Return the candidates that say that a program exchanges joints in one observation, or in the actions."""
    terms = {name for name, values in statistics.items() if is_of_joints(name, values, info)}
    return [one for one in candidates if one.kind == "order" and one.term in {*terms, ACTIONS}]


def is_of_joints(name: str, values: TermStatistics, info: EnvInfo) -> bool:
    """Return whether an observation has a quantity of each joint that its driver measures."""
    joints = info.joints
    if joints is None or name == ACTIONS or len(values.mean) != len(joints.names):
        return False
    if name in _list_clips(info):
        return False
    return name == joints.measured or name.startswith("joint")


def _name_swapped(order: tuple[int, ...], names: Sequence[str]) -> str:
    """Return what is wrong where two joints are exchanged; empty for other orders."""
    moved = [index for index, other in enumerate(order) if index != other]
    if len(moved) != 2:
        return ""
    one, other = moved
    return f"elements {one} and {other} ({names[one]} and {names[other]}) are swapped"


def _name_reversed(factor: tuple[float, ...], names: Sequence[str]) -> str:
    reversed_joints = [name for name, value in zip(names, factor, strict=True) if value < 0]
    return f" ({reversed_joints[0]})" if len(reversed_joints) == 1 else ""


def _make_part(
    name: str, values: TermStatistics, info: EnvInfo, kind: Kind, order: tuple[int, ...], factor: tuple[float, ...]
) -> Correction:
    """Return what exchanged, reversed or otherwise measured angles are in an observation or in the actions.

    The right angles are `factor * angle[order]`.
    """
    stance = find_stance(name, values, info)
    if stance is None:
        return Correction(name, kind, "", order, factor)
    pose, scale = stance
    there, factors = list(order), np.array(factor)
    # program's angle = pose + scale * value; the right one is factor * angle[order].
    offset = (factors * pose[there] - pose) / scale
    of_values = factors * scale[there] / scale
    shifts = () if np.allclose(offset, 0.0) else tuple(offset.tolist())
    return Correction(name, kind, "", order, tuple(of_values.tolist()), shifts)


def find_stance(name: str, values: TermStatistics, info: EnvInfo) -> tuple[Array, Array] | None:
    """Return the angles [rad or m] for which a term is 0, and for which it is 1 more; None if it is no such term."""
    joints = info.joints
    if joints is None or len(joints.default_positions) != len(values.mean):
        return None
    pose = np.array(joints.default_positions)
    if name == ACTIONS:
        return (pose, np.array(joints.action_scale)) if joints.action_scale else None
    # Angles themselves are near the stance in simulation, differences from it near 0.
    is_difference = np.linalg.norm(values.mean) < np.linalg.norm(values.mean - pose)
    is_angle = name == joints.measured or info.observation_units.get(name) in ("rad", "m")
    return (pose, np.ones(len(pose))) if is_angle and is_difference else None


def _list_signs(name: str, size: int) -> Iterator[Correction]:
    for index in range(size):
        yield make_sign(name, size, [index])
    if size > 1:
        yield make_sign(name, size, range(size))
    for period in (period for period in (2, 3) if size % period == 0 and size > period):
        for first in range(period):
            yield make_sign(name, size, range(first, size, period))


def make_sign(name: str, size: int, elements: Sequence[int]) -> Correction:
    """Return the correction of elements that have the wrong sign."""
    factor = np.ones(size)
    factor[list(elements)] = -1.0
    return Correction(name, "sign", f"{name_elements(elements, size)} the wrong sign", factor=tuple(factor.tolist()))


def name_elements(elements: Sequence[int], size: int, verb: tuple[str, str] = ("has", "have")) -> str:
    """Return `element 3 has`, `elements 3, 4 have` or `all elements have`."""
    if len(elements) == size:
        return f"it {verb[0]}" if size == 1 else f"all elements {verb[1]}"
    if len(elements) == 1:
        return f"element {elements[0]} {verb[0]}"
    return f"elements {', '.join(str(index) for index in elements)} {verb[1]}"


def _list_units(name: str, size: int, info: EnvInfo) -> Iterator[Correction]:
    """Yield the units with which a program confuses that of a term; a joint's angle is never in millimetres."""
    for factor, text in _UNITS_OF.get(info.observation_units.get(name, ""), _ANY_UNITS):
        yield Correction(name, "unit", text, factor=(factor,) * size)


def _list_factors(name: str, size: int) -> Iterator[Correction]:
    for factor in _FACTORS:
        yield make_scale(name, size, range(size), factor)
        if size > 1 and factor in (0.5, 2.0):
            for index in range(size):
                yield make_scale(name, size, [index], factor)


def make_scale(name: str, size: int, elements: Sequence[int], factor: float) -> Correction:
    """Return the correction that multiplies elements by `factor`."""
    factors = np.ones(size)
    factors[list(elements)] = factor
    if name == ACTIONS:
        text = f"{name_elements(elements, size, ('acts', 'act'))} {factor:.3g} times as strongly as in simulation"
    else:
        text = f"{name_elements(elements, size, ('is', 'are'))} {1 / factor:.3g} times too large"
    return Correction(name, "scale", text, factor=tuple(factors.tolist()))


def make_offset(name: str, elements: Sequence[int], offset: Array) -> Correction:
    """Return the correction that adds `offset`, shape (elements,)."""
    shown = ", ".join(f"{-value:.3g}" for value in offset[list(elements)])
    text = f"{name_elements(elements, len(offset))} an offset of {shown}"
    return Correction(name, "offset", text, offset=tuple(offset.tolist()))


def _list_default_poses(name: str, size: int, info: EnvInfo) -> Iterator[Correction]:
    joints = info.joints
    if joints is None or len(joints.default_positions) != size or not any(joints.default_positions):
        return
    pose = np.array(joints.default_positions)
    if name == ACTIONS:
        if joints.action_scale:
            scale = np.array(joints.action_scale)
            yield Correction(
                name,
                "scale",
                "the logged actions are the joints' targets, default pose + action scale * action",
                factor=tuple((1 / scale).tolist()),
                offset=tuple((-pose / scale).tolist()),
            )
        return
    for sign, text in ((1.0, "the default pose was subtracted"), (-1.0, "the default pose was not subtracted")):
        yield Correction(name, "offset", text, offset=tuple((sign * pose).tolist()))


def _list_frames(name: str, info: EnvInfo, statistics: Mapping[str, TermStatistics]) -> Iterator[Correction]:
    for other, values in statistics.items():
        is_attitude = len(values.mean) == 3 and info.observation_units.get(other) == "rad" and "attitude" in other
        if other == name or not (values.is_quaternion or is_attitude):
            continue
        yield Correction(name, "frame", "is in the world's frame, not in the body's", frame="to body", attitude=other)
        yield Correction(name, "frame", "is in the body's frame, not in the world's", frame="to world", attitude=other)


def make_normalised(normalize: Normalize) -> Correction:
    """Return the correction of observations that were normalised before they were logged."""
    return Correction(
        EVERYTHING,
        "normalised",
        "the logged values are normalised already; the policy normalises them itself",
        factor=tuple(np.sqrt(normalize.variance + normalize.epsilon).tolist()),
        offset=tuple(np.asarray(normalize.mean, np.float64).tolist()),
    )
