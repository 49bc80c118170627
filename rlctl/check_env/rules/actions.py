"""RL7: the actions do something, in all of their range, and only there."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import NotApplicable, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.results import ActionEffect, ActionEffects, OutOfRange
from rlctl.check_env.rules.known import built, result

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO

MOST_NAMES = 8
"""So many dimensions are named in a message."""


def _effects(evidence: Evidence) -> ActionEffects:
    return result(evidence, ActionEffects, "action effects")


def _names(effects: list[ActionEffect]) -> str:
    names = ", ".join(each.name for each in effects[:MOST_NAMES])
    return names + (f" and {len(effects) - MOST_NAMES} more" if len(effects) > MOST_NAMES else "")


def _seen(effects: list[ActionEffect], known: ActionEffects, message: str, severity: Severity) -> Seen:
    judged = f" ({len(known.dimensions)} of {known.total} dimensions were tried: {known.left_out})"
    evidence = {
        "value": [each.name for each in effects],
        "seed": effects[0].seeds[0],
        "seeds": effects[0].seeds,
        "steps": max(each.steps for each in effects),
        "dimensions_tried": len(known.dimensions),
        "dimensions": known.total,
    }
    return Seen(message + (judged if known.left_out else ""), evidence, severity)


@rule(
    "RL701",
    "action without effect",
    WARNING,
    "Use every number of the action in step(), or take it out of action_space. Look for a wrong index, a joint that "
    "is not the motor's, a force or gain of zero.",
    needs=("action effects",),
)
def without_effect(evidence: Evidence) -> Iterator[Seen]:
    """The same episode with a number of the action at its lowest, and at its highest, value comes out the same to the
    last bit. Noise on an action that does nothing only costs exploration; if no action does anything, there is nothing
    to learn. An action that only adds to its own step's reward (a cost) moves nothing either."""
    known = _effects(evidence)
    kinds = {kind: [each for each in known.dimensions if each.effect == kind] for kind in ("none", "cost", "copy")}
    acting = any(each.effect == "lasting" for each in known.dimensions)
    dead, costly, copied = kinds["none"], kinds["cost"], kinds["copy"]
    if dead:
        steps = max(each.steps for each in dead)
        tried = f"at its lowest and highest value, over {steps} steps from two seeds, no observation, reward or end"
        all_dead = len(dead) == known.total
        what = "no action has any effect" if all_dead else f"{_names(dead)} without any effect"
        yield _seen(dead, known, f"{what}: {tried} changes", ERROR if all_dead else WARNING)
    if costly:
        message = f"{_names(costly)} changes nothing but its own step's reward, a cost for doing nothing"
        # If no action moves anything, it is a bandit, or a series that is only watched.
        yield _seen(costly, known, message, WARNING if acting else INFO)
    if copied:
        message = f"{_names(copied)} changes nothing but its own copy in the observation"
        yield _seen(copied, known, message, INFO)


@rule(
    "RL702",
    "action saturates",
    WARNING,
    "Scale the action so that its bounds are what the actuator can do: remove the gain before the clip, or declare "
    "the range that acts.",
    needs=("action effects",),
)
def saturates(evidence: Evidence) -> Iterator[Seen]:
    """In both directions, a fifth of the action's range does all that the whole range does. Most of what a policy
    explores is then the same action, and it learns bang-bang control."""
    known = _effects(evidence)
    narrow = [each for each in known.dimensions if each.saturates == "range"]
    switches = [each for each in known.dimensions if each.saturates == "switch"]
    if narrow:
        yield _seen(narrow, known, f"{_names(narrow)}: from 0.2 of its range on, nothing changes", WARNING)
    if switches:
        yield _seen(switches, known, f"{_names(switches)}: from 0.01 of its range on, nothing changes: a switch", INFO)


@rule(
    "RL703",
    "actions out of range act",
    INFO,
    "action = np.clip(action, self.action_space.low, self.action_space.high) first in step(), before it is rewarded "
    "too.",
    needs=("out of range",),
)
def out_of_range(evidence: Evidence) -> Iterator[Seen]:
    """Twice the largest action does something else than the largest, without an exception. Stable-Baselines3 clips,
    other learners and a deployed policy may not: there the robot gets forces that it never had in training."""
    _require_bounded(evidence)
    found = result(evidence, OutOfRange, "out of range")
    if found.raised is not None or not found.difference:
        return
    what = {"observation": "an observation", "reward": "the reward", "end": "whether the episode ends"}
    message = (
        f"with twice the largest actions {what[found.difference]} is {found.outside:.6g} at step {found.step}, "
        f"{found.inside:.6g} with the largest"
    )
    yield Seen(message, {"seed": found.seed, "step": found.step, "value": found.outside, "expected": found.inside})


def _require_bounded(evidence: Evidence) -> None:
    for leaf in built(evidence).action_leaves:
        if leaf.kind == "Box" and leaf.low is not None and leaf.high is not None:
            bounded = np.isfinite(leaf.low) & np.isfinite(leaf.high)
            if leaf.dtype.startswith("float") and bounded.any():
                return
    raise NotApplicable("no continuous action with finite bounds")
