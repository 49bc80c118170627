"""RL109: space not supported for training."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments.leaves import Leaf, name_leaf

RULE = Rule(
    "RL109",
    "space not supported for training",
    Severity.WARNING,
    meaning="""
        Stable-Baselines3 has no network for this kind of space, or for categories that do not count from 0.
    """,
    fix="""
        Use Box, Discrete, MultiDiscrete or MultiBinary, or one Dict of them for observations; wrappers in
        gymnasium.wrappers convert.
    """,
    is_about_space=True,
    allows_old_gym=True,
)


@judges_records(RULE, "build")
def _find_unsupported_spaces(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    for what, leaves, depth in (("observation", built.leaves, 1), ("action", built.action_leaves, 0)):
        for leaf in leaves:
            if kind := _unsupported_kind(leaf, depth):
                name, part = name_leaf(leaf, what), "part " if leaf.supported and leaf.path else ""
                message = f"{name} is {part}of a {kind}; SB3 has no network for it"
                yield RuleFinding(RULE, message, {"element": name, "value": kind})
                break


def _unsupported_kind(leaf: Leaf, depth: int) -> str:
    if not leaf.supported:
        return f"{leaf.kind} space"
    if any(isinstance(key, int) for key in leaf.path):
        return "Tuple space"
    if len(leaf.path) > depth:
        return "nested Dict space" if depth else "Dict space"
    if leaf.kind == "MultiDiscrete" and len(leaf.shape) > 1:
        return "MultiDiscrete space of several axes"
    if leaf.kind in ("Discrete", "MultiDiscrete") and np.any(leaf.low):
        return f"{leaf.kind} space that does not count from 0"
    return ""
