"""What the name of a reward term says that the term is."""

import re
from collections.abc import Collection

ACTION_WORDS = {
    "action", "actions", "actuation", "control", "ctrl", "effort", "jerk", "smooth", "smoothness", "torque", "torques",
}  # fmt: skip
ENERGY_WORDS = {"energy", "power"}
COST_WORDS = {"cost", "costs", "penalty", "penalties", "punishment"}
"""What lowers a reward, whatever it is computed from."""
NEUTRAL_WORDS = {
    "acc", "acceleration", "change", "consumption", "delta", "diff", "difference", "dof", "first", "input", "inputs",
    "joint", "joints", "l1", "l2", "magnitude", "mean", "motor", "motors", "norm", "order", "r", "rate", "reg",
    "regularization", "rew", "reward", "second", "size", "squared", "sum", "term", "total", "usage", "use",
}  # fmt: skip
"""What may stand beside an action word without saying that only a part, or what is beyond a limit, counts."""
ERROR_WORDS = {
    "away", "collision", "collisions", "deviation", "dist", "distance", "error", "excess", "fall", "fallen",
    "misaligned", "misalignment", "posture", "slip", "tilt",
}  # fmt: skip
"""Sizes that a task wants to be small."""
OPPOSITE_WORDS = {
    "avoid", "avoidance", "avoided", "below", "bonus", "exp", "improvement", "inverse", "less", "low", "minus", "neg",
    "negative", "no", "progress", "reduced", "reduction", "reward", "saved", "saving", "savings", "small", "within",
    "without",
}  # fmt: skip
"""What turns the meaning of the other words around."""


def split_name(name: str) -> list[str]:
    """Return the words of a name in lower case: `actionRate`, `action_rate` and `Action rate` have the same."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name)
    return re.findall(r"[a-z0-9]+", spaced.lower())


def is_about_actions(name: str, more: Collection[str] = ()) -> bool:
    """Say whether a term is the size of the actions, of their change or of what motors do, and of nothing else."""
    words, about = set(split_name(name)), ACTION_WORDS | set(more)
    return bool(words & about) and words <= about | COST_WORDS | NEUTRAL_WORDS


def is_cost(name: str) -> bool:
    """Say whether a name calls the term a cost or a penalty."""
    words = set(split_name(name))
    return bool(words & COST_WORDS) and not words & OPPOSITE_WORDS


def is_error(name: str) -> bool:
    """Say whether a term is a size that is better small, such as a distance."""
    words = set(split_name(name))
    return bool(words & (ERROR_WORDS | COST_WORDS | ACTION_WORDS)) and not words & OPPOSITE_WORDS
