"""RL6: whether parts of the reward measure what they are called after."""

from __future__ import annotations

import re
from collections.abc import Iterator

from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import NotJudged, Seen, Severity, rule
from rlctl.check_env.rules.known import result
from rlctl.check_env.rules.physics import watched
from rlctl.check_env.world_results import Likeness, Worlds

EXACT = 0.999
"""From this R^2 on a part of the reward is a line through a quantity: numbers that only go along with each other in a
few hundred steps of random actions stay well below."""

SPEEDS = ("linear velocity", "angular velocity", "joint velocity")
ANGLES = ("angle", "joint position")
MEANINGS: dict[str, tuple[frozenset[str], tuple[str, ...]]] = {
    "a speed": (
        frozenset({"velocity", "velocities", "vel", "speed", "rate"}),
        ("position", "height", *ANGLES),
    ),
    "progress": (frozenset({"forward", "progress", "advance"}), ("angle", "angular velocity")),
    "an angle": (
        frozenset({"pitch", "roll", "yaw", "tilt", "upright", "orientation", "heading", "angle", "lean"}),
        SPEEDS,
    ),
    "a height": (frozenset({"height", "altitude"}), ("position", "angle", *SPEEDS)),
}
"""What a name means: its words, and the kinds of quantities that it does not mean. The first that fits counts."""


@rule(
    "RL613",
    "reward term measures something else",
    Severity.WARNING,
    "Look at the index it is read with: getBasePositionAndOrientation gives position and quaternion, getBaseVelocity "
    "linear before angular; give the parts of an observation names and read them by these.",
    needs=("worlds",),
)
def measures_its_name(evidence: Evidence) -> Iterator[Seen]:
    """A part of the reward in info goes exactly with another quantity than its name says: a velocity that is a pitch,
    most often by a wrong index. The policy then learns something else than what the curves are called after."""
    watched(evidence)
    seen = result(evidence, Worlds, "worlds")
    if not seen.steps:
        raise NotJudged("no step could be watched")
    for term in dict.fromkeys(each.term for each in seen.likenesses):
        likenesses = [each for each in seen.likenesses if each.term == term and each.r2 >= EXACT]
        meaning = _meaning(term)
        if meaning is None or not likenesses:
            continue
        best = max(likenesses, key=lambda each: each.r2)
        # What is also a line through a quantity of its own kind may well be that one.
        if all(each.kind in MEANINGS[meaning][1] for each in likenesses):
            yield _seen(meaning, best)


def _meaning(term: str) -> str | None:
    words = set(re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", term.rpartition("/")[2]).lower()))
    return next((meaning for meaning, (names, _) in MEANINGS.items() if names & words), None)


def _seen(meaning: str, like: Likeness) -> Seen:
    return Seen(
        f"{like.term!r} should be {meaning}, but is {like.slope:.4g} times the {like.kind} {like.quantity} (up to a "
        f"constant; R^2 {like.r2:.6f} in {like.steps} steps)",
        {"term": like.term, "value": like.kind, "expected": meaning, "r2": like.r2, "slope": like.slope},
    )
