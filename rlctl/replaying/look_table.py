"""Prints what was seen of a world: a table of bodies, one of joints, and what falls."""

from collections.abc import Iterator, Sequence

from rlctl import output
from rlctl.replaying.look import TIPPED, Contact, JointSummary, Motion, WorldSummary

_SHOWN_CONTACTS = 16
_DEEP = 1e-4  # [m]; smaller overlaps are those of any contact
_UPRIGHT = 10.0  # [degrees]; what tilts further may be about to fall
_WIDE = 100.0  # larger limits are written in few digits


def show_world(world: WorldSummary) -> None:
    """Print bodies, joints, contacts and what falls."""
    motions = {motion.body: motion for motion in world.motions}
    rows = []
    for body in world.bodies:
        joints = str(len(body.joints)) if body.joints else ""
        rows.append([body.name, f"{body.mass:.4g}", body.base, joints, *_format_heights(motions.get(body.name))])
    _print(["body", "kg", "base", "joints", "height m", "lowest", "highest", "end", "tilt deg"], rows)
    rows = [[body.name, joint.name, *_format_joint(joint)] for body in world.bodies for joint in body.joints]
    _print(["body", "joint", "low", "high", "", "at reset", "max force", "max speed"], rows)
    rows = [_format_contact(contact) for contact in world.contacts[:_SHOWN_CONTACTS]]
    _print(["body", "link", "touches", "from step", "mm deep"], rows)
    for line in list_findings(world):
        output.out().print(line)


_DROPPED = ("max speed", "max force", "highest", "lowest", "mm deep")  # on a narrow terminal
_LEFT = ("body", "base", "joint", "", "link", "touches")  # columns of text


def _print(names: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table without its empty columns."""
    filled = [number for number, _ in enumerate(names) if any(row[number] for row in rows)]
    if rows:
        chosen = [names[number] for number in filled]
        cells = [[row[number] for number in filled] for row in rows]
        output.print_table(chosen, cells, left=_LEFT, drop=[name for name in _DROPPED if name in chosen])
        output.out().print()


def _format_heights(motion: Motion | None) -> list[str]:
    if motion is None:
        return [""] * 5
    heights = (motion.start, motion.lowest, motion.highest, motion.end)
    return [*(f"{height:.3f}" for height in heights), f"{motion.tilt:.0f}"]


def _format_contact(contact: Contact) -> list[str]:
    other = "itself" if contact.other == contact.body else contact.other
    overlap = f"{1000 * contact.overlap:.1f}" if contact.overlap >= _DEEP else ""
    return [contact.body, contact.link, other, str(contact.step), overlap]


def _format_joint(joint: JointSummary) -> list[str]:
    limits = [_format_limit(limit) for limit in (joint.low, joint.high)]
    unit = "N m" if joint.unit == "rad" else "N"
    force = "" if joint.max_force is None else f"{joint.max_force:.4g} {unit}"
    speed = "" if joint.max_speed is None else f"{joint.max_speed:.4g} {joint.unit}/s"
    return [*limits, joint.unit, f"{joint.start:.3f}", force, speed]


def _format_limit(limit: float | None) -> str:
    if limit is None:
        return "none"
    return f"{limit:.3f}" if abs(limit) < _WIDE else f"{limit:.3g}"


def list_findings(world: WorldSummary) -> Iterator[str]:
    """Yield a line per joint outside its limits and per body that falls, or that there is nothing to report."""
    for body in world.bodies:
        for joint in body.joints:
            if joint.is_outside:
                yield (
                    f"{body.name}: joint {joint.name} begins at {joint.start:.3f} {joint.unit}, outside its limits "
                    f"{_format_limit(joint.low)} to {_format_limit(joint.high)}"
                )
    if not world.contacts:
        yield "nothing touches"
    elif (more := len(world.contacts) - _SHOWN_CONTACTS) > 0:
        yield f"{output.format_count(more, 'further contact')}: see --json FILE"
    falls = [line for motion in world.motions if (line := _describe_fall(motion, world.dt))]
    yield from falls
    if world.motions and not falls:
        furthest = max(world.motions, key=lambda motion: motion.tilt)
        if furthest.tilt < _UPRIGHT:
            yield "nothing falls"
        else:
            tilts = f"{furthest.body} tilts by {furthest.tilt:.0f}"
            yield f"nothing drops by a fifth or tips by {TIPPED:.0f} degrees; {tilts}"


def _describe_fall(motion: Motion, dt: float | None) -> str:
    if motion.lost_at is not None:
        return f"{motion.body}: its position is not finite after step {motion.lost_at}: the simulation has diverged"
    parts = []
    if motion.dropped_at is not None:
        when = _format_step(motion.dropped_at, dt)
        parts.append(f"drops from {motion.start:.3f} to {motion.lowest:.3f} m (a fifth by {when})")
    if motion.tipped_at is not None:
        when = _format_step(motion.tipped_at, dt)
        parts.append(f"tips by {motion.tilt:.0f} degrees ({TIPPED:.0f} by {when})")
    return f"{motion.body} {' and '.join(parts)}" if parts else ""


def _format_step(step: int, dt: float | None) -> str:
    return f"step {step}" if dt is None else f"step {step}, {step * dt:.2f} s"
