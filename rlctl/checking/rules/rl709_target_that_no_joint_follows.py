"""RL709: target that no joint follows."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rlctl.checking.episode import action_at
from rlctl.checking.experiments.sums import ActionSum, EngineState, FoundSums, judges_sums
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.worlds import Array

RULE = Rule(
    "RL709",
    "target that no joint follows",
    Severity.WARNING,
    meaning="""
        The observation has a number that adds up an element of the action and begins where, or near where, a joint
        does: its target. That joint does not follow: the check played the same episode with opposite values of this
        element, and everything in the engine stayed the same to the bit, while with other elements of the action it did
        not. The policy sees a target move, and commands nothing. Most often the loop that commands the motors ends too
        early, or skips one.
    """,
    fix="Command all motors: for i in range(len(targets)), and compare the list of joints with the size of the action.",
)

STEPS = 16
SEEDS = (FIRST_SEED, FIRST_SEED + 1)
SAME, NEAR = 1e-5, 0.1  # of a target and its joint at reset, which float32 rounds; where joints begin with noise
Looks = list[tuple[Array, EngineState]]


@judges_sums(RULE)
def _find_unfollowed(found: FoundSums) -> Iterator[ChildMessage]:
    sums = [one for one in found.sums if one.column < found.observed]
    elements = sorted({one.element for one in sums})
    if not found.trials.has_engine or len(elements) < 2:
        return
    plain = [_play(found, seed) for seed in SEEDS]
    if not all(_is_same(one, _play(found, seed)) for one, seed in zip(plain, SEEDS, strict=True)):
        raise NotJudged("an episode with the same seed and actions is not the same again (RL302)")
    idle = [element for element in elements if all(_is_same(plain[i], _play(found, SEEDS[i], element)) for i in (0, 1))]
    if len(idle) == len(elements):
        return
    for one in sums:
        joint = (
            _find_joint(one, [other for other in sums if other.element not in idle], plain)
            if one.element in idle
            else ""
        )
        if joint:
            name, others = found.trials.name(one.column), [element for element in elements if element not in idle]
            message = (
                f"{name} adds up action[{one.element}] and begins where joint {joint} does, which does not follow: the"
            )
            message += (
                f" same {STEPS} steps with opposite values of action[{one.element}] leave everything in the engine"
            )
            message += f" the same, and with action[{others[0]}] they do not"
            evidence = {"element": name, "value": joint, "seed": SEEDS[0], "steps": STEPS}
            yield RuleFinding(RULE, message, evidence)
            return


def _play(found: FoundSums, seed: int, element: int | None = None) -> Looks:
    """Play random actions, all numbers or all but one of them; of this, the opposite ones."""
    instance = found.trials.instance
    size = sum(int(np.prod(leaf.shape)) for leaf in instance.action_leaves)
    parts = np.random.default_rng(seed).uniform(size=(STEPS, size))
    if element is not None:
        parts[:, element] = 1 - parts[:, element]
    actions: list[Any] = [action_at(instance.env.action_space, row) for row in parts]
    return found.trials.play_bodies(seed, actions)


def _is_same(one: Looks, two: Looks) -> bool:
    pairs = zip(one, two, strict=False)
    return len(one) == len(two) > 1 and all(np.array_equal(a[1].everything, b[1].everything) for a, b in pairs)


def _find_joint(one: ActionSum, others: Sequence[ActionSum], plain: Sequence[Looks]) -> str:
    """Return the joint that begins where a target does, in all episodes, or near it, where no other target begins near
    that joint; empty if there is none. Not every number that adds up an action is a target of the engine."""
    starts = [played[0] for played in plain]
    for error in (SAME, NEAR):
        for number, joint in enumerate(starts[0][1].joints):
            if any(len(state.positions) <= number for _, state in starts):
                continue
            places = np.array([state.positions[number] for _, state in starts])
            targets = np.array([observed[one.column] for observed, _ in starts])
            is_near = (targets != 0).all() and (np.abs(targets - places) <= error).all()
            is_taken = error == NEAR and any(
                (np.abs(np.array([observed[other.column] for observed, _ in starts]) - places) <= error).all()
                for other in others
            )
            if is_near and not is_taken:
                return joint
    return ""
