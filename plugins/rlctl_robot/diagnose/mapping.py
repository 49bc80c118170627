"""The corrected mapping as data: what a program must do to logged values and to actions, per observation."""

from collections.abc import Collection, Iterable, Sequence

import numpy as np
import pydantic

from rlctl.storage.validation import Number, Section, Whole
from rlctl.task.joints import Joints
from rlctl_robot.diagnose.correction import EVERYTHING, Correction, list_parts
from rlctl_robot.diagnose.signals import ACTIONS


class TermMapping(Section):
    """corrected = sign * scale * value[order] + offset; a key that is left out changes nothing."""

    order: list[Whole] | list[str] | None = None
    """Element of the program's value for each element of the policy's; of a quaternion, the program's x, y, z and w."""
    sign: list[Number] | None = None
    """1 or -1 for each element."""
    scale: list[Number] | None = None
    """Positive factor for each element."""
    offset: list[Number] | None = None
    """Added to each element, in the policy's unit."""
    delay: Whole = 0
    """Control steps by which the value is late; a program must find out why."""
    frame: str | None = None
    """`to body` or `to world`: the vector must be turned into this frame."""

    @pydantic.model_serializer(mode="wrap")
    def _shorten(self, serialize: pydantic.SerializerFunctionWrapHandler) -> dict[str, object]:
        """Write one number for equal ones."""
        content: dict[str, object] = serialize(self)
        for key, values in (("scale", self.scale), ("offset", self.offset)):
            if values and len(set(values)) == 1:
                content[key] = values[0]
        return content


class LogMapping(Section):
    """What the log holds otherwise than the policy received and returned; a program needs no change for it."""

    observations: dict[str, TermMapping] = {}
    """From the logged value to what the policy received, per observation."""
    actions: TermMapping | None = None
    """From the logged action to what the policy returned."""


class CorrectedMapping(Section):
    """What to change between a robot and a policy."""

    observations: dict[str, TermMapping] = {}
    """From the program's value to the policy's, per observation; `rlctl export --controller --mapping` reads it."""
    actions: TermMapping | None = None
    """From the policy's action to what the program must send."""
    targets: TermMapping | None = None
    """The same of the joints' targets, which a controller returns: from the policy's to the program's."""
    log: LogMapping | None = None


def build_mapping(
    of_log: Sequence[Correction],
    of_robot: Sequence[Correction],
    sizes: dict[str, int],
    joints: Joints | None = None,
    *,
    is_of_controller: bool = False,
    quaternions: Collection[str] = (),
) -> CorrectedMapping:
    """Return the mapping that corrections of the log alone and of the robot make.

    With `is_of_controller` the program has angles where the policy observes differences from the stance, and needs only
    what to do to the targets. The elements of `quaternions` (x, y, z, w) are named.
    """
    of_log, of_robot = list_parts(of_log), list_parts(of_robot)
    sent = [one for one in of_robot if one.term == ACTIONS]
    logged = [one for one in of_log if one.term == ACTIONS]
    observations, log_actions = _compose_terms(of_log, sizes), compose(logged) if logged else None
    terms = _compose_terms(of_robot, sizes)
    if is_of_controller and joints is not None and joints.measured in terms:
        own = [one for one in of_robot if one.term == joints.measured]
        if joints.default_positions and all(one.kind in ("order", "sign", "unit") for one in own):
            pose = np.array(joints.default_positions)
            terms[joints.measured] = _shift(terms[joints.measured], pose, np.ones(len(pose)))
    for name in terms.keys() & set(quaternions):
        terms[name] = _name_elements(terms[name])
    actions, targets = invert(sent) if sent else None, None
    if sent and joints is not None:
        targets = _find_targets(sent, of_robot, joints)
    if is_of_controller and targets is not None:
        actions = None  # the program does not see the policy's actions
    return CorrectedMapping(
        observations=terms,
        actions=actions,
        targets=targets,
        log=LogMapping(observations=observations, actions=log_actions) if of_log else None,
    )


def _name_elements(mapping: TermMapping) -> TermMapping:
    """Return the mapping of a quaternion with the names of the program's elements, such as w, x, y, z."""
    if not mapping.order:
        return mapping
    places = np.argsort(mapping.order)  # element of the policy's quaternion for each of the program's
    return mapping.model_copy(update={"order": ["xyzw"[place] for place in places]})


def _compose_terms(corrections: Sequence[Correction], sizes: dict[str, int]) -> dict[str, TermMapping]:
    """Return the mapping of each observation; a correction of all together has a part for each."""
    parts: dict[str, list[Correction]] = {}
    for one in corrections:
        if one.term == EVERYTHING and EVERYTHING not in sizes:
            begin = 0
            for name, size in sizes.items():
                part = slice(begin, begin + size)
                scale = Correction(name, "scale", "", factor=one.factor[part], offset=one.offset[part])
                parts.setdefault(name, []).append(scale)
                begin += size
        elif one.term != ACTIONS:
            parts.setdefault(one.term, []).append(one)
    return {name: compose(some) for name, some in parts.items()}


def compose(corrections: Iterable[Correction]) -> TermMapping:
    """Return several corrections of one term as one mapping."""
    order: np.ndarray | None = None
    factor: np.ndarray | None = None
    offset: np.ndarray | None = None
    delay, frame = 0, None
    for one in corrections:
        size = max(len(one.order), len(one.factor), len(one.offset))
        if size:
            order = np.arange(size) if order is None else order
            factor = np.ones(size) if factor is None else factor
            offset = np.zeros(size) if offset is None else offset
            if one.order:
                order, factor, offset = order[list(one.order)], factor[list(one.order)], offset[list(one.order)]
            if one.factor:
                factor, offset = factor * np.array(one.factor), offset * np.array(one.factor)
            if one.offset:
                offset = offset + np.array(one.offset)
        delay, frame = delay + one.delay, one.frame or frame
    return _make(order, factor, offset, delay, frame)


def invert(corrections: Sequence[Correction]) -> TermMapping:
    """Return what a program must send, so that the robot executes the policy's action."""
    whole = compose(corrections)
    size = max((len(values) for values in (whole.order, whole.sign, whole.scale, whole.offset) if values), default=0)
    if not size:
        return whole
    order = np.array(whole.order if whole.order else range(size))
    factor = np.array(whole.sign or np.ones(size)) * np.array(whole.scale or np.ones(size))
    offset = np.array(whole.offset or np.zeros(size))
    # executed = factor * sent[order] + offset, so sent[order] = (action - offset) / factor.
    back = np.argsort(order)
    return _make(back, (1 / factor)[back], (-offset / factor)[back], whole.delay, None)


def _find_targets(sent: Sequence[Correction], of_robot: Sequence[Correction], joints: Joints) -> TermMapping | None:
    """Return the mapping from the policy's targets of the joints to the program's; None where it is unknown."""
    if any(one.delay for one in sent):
        return None
    if joints.action_scale and joints.default_positions:
        return _shift(invert(sent), np.array(joints.default_positions), np.array(joints.action_scale))
    positions = [one for one in of_robot if one.term == joints.measured]
    measured = {(one.order, tuple(np.sign(one.factor))) for one in positions}
    commanded = {(one.order, tuple(np.sign(one.factor))) for one in sent}
    # A target is a measured position and a step: known if the driver confuses both in the same way.
    return invert(positions) if measured == commanded else None


def _shift(mapping: TermMapping, pose: np.ndarray, scale: np.ndarray) -> TermMapping:
    """Return a mapping of values as one of pose + scale * value."""
    size = len(pose)
    order = np.arange(size) if mapping.order is None else np.array(mapping.order)
    factor = np.array(mapping.sign or np.ones(size)) * np.array(mapping.scale or np.ones(size))
    offset = np.array(mapping.offset or np.zeros(size))
    # value = (x - pose) / scale, so pose + scale * (factor * value[order] + offset) is in terms of x[order]:
    of_x = scale * factor / scale[order]
    return _make(order, of_x, pose + scale * offset - of_x * pose[order], mapping.delay, mapping.frame)


def _make(
    order: np.ndarray | None, factor: np.ndarray | None, offset: np.ndarray | None, delay: int, frame: str | None
) -> TermMapping:
    content: dict[str, object] = {"delay": delay, "frame": frame or None}
    if order is not None and order.tolist() != list(range(len(order))):
        content["order"] = order.tolist()
    if factor is not None and (factor < 0).any():
        content["sign"] = np.sign(factor).tolist()
    if factor is not None and not np.allclose(np.abs(factor), 1.0):
        content["scale"] = [float(f"{value:.5g}") for value in np.abs(factor)]
    if offset is not None and not np.allclose(offset, 0.0, atol=1e-4):
        content["offset"] = [float(f"{value:.5g}") + 0.0 for value in offset]  # no -0.0
    return TermMapping.model_validate(content)
