"""What the name of a reward term says that the term is."""

import re
from collections.abc import Collection

ACTION_WORDS = {
    "action", "actions", "actuation", "control", "ctrl", "effort", "jerk", "smooth", "smoothness", "torque", "torques",
}  # fmt: skip
ENERGY_WORDS = {"energy", "power"}
COST_WORDS = {"cost", "costs", "penalty", "penalties", "punishment"}
"""What lowers a reward, whatever it is computed from."""
CHANGE_WORDS = {"change", "changes", "changing", "chatter", "delta", "diff", "difference", "jitter"}
"""What happens to an action from step to step, where nothing else is named that changes."""
NEUTRAL_WORDS = {
    "acc", "acceleration", "consumption", "dof", "first", "input", "inputs", "joint", "joints", "l1", "l2", "magnitude",
    "mean", "motor", "motors", "norm", "order", "r", "rate", "reg", "regularization", "rew", "reward", "second", "size",
    "squared", "sum", "term", "total", "usage", "use",
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


TIME_WORDS = {"delay", "duration", "elapsed", "step", "steps", "time", "timestep"}
GOAL_WORDS = {
    "arrival", "arrived", "complete", "completed", "dist", "distance", "done", "finish", "finished", "goal", "goals",
    "progress", "reach", "reached", "reaching", "success", "target", "targets", "waypoint", "waypoints",
}  # fmt: skip
"""What terms are named after where a task has an end that is to come soon."""
PLACE_WORDS = {"goal", "goals", "target", "targets", "waypoint", "waypoints"}
STEPPING_WORDS = {"clearance", "airtime", "swing", "lift", "liftoff"}
"""What feet do while a robot walks, and not while it stands."""
GRASP_WORDS = {"grasp", "grasped", "grasping", "grip", "gripping", "pinch", "hold", "holding", "clamp", "squeeze"}
OPEN_WORDS = {"open", "opening", "opened", "release", "released"}


def split_name(name: str) -> list[str]:
    """Return the words of a name in lower case: `actionRate`, `action_rate` and `Action rate` have the same."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name)
    return re.findall(r"[a-z0-9]+", spaced.lower())


def is_about_actions(name: str, more: Collection[str] = ()) -> bool:
    """Say whether a term is the size of the actions, of their change or of what motors do, and of nothing else."""
    words, about = set(split_name(name)), ACTION_WORDS | set(more)
    return bool(words & about) and words <= about | COST_WORDS | NEUTRAL_WORDS | CHANGE_WORDS


def is_cost(name: str) -> bool:
    """Say whether a name calls the term a cost or a penalty."""
    words = set(split_name(name))
    return bool(words & COST_WORDS) and not words & OPPOSITE_WORDS


def is_about_time(name: str) -> bool:
    """Say whether a term is what each step costs, and nothing else."""
    words = set(split_name(name))
    return bool(words & TIME_WORDS) and words <= TIME_WORDS | COST_WORDS | {"per", "spent", "used"}


def is_about_goals(name: str) -> bool:
    """Say whether a term is about a place or a state that ends the task, or the next part of it."""
    return bool(set(split_name(name)) & GOAL_WORDS)


def is_place(name: str) -> bool:
    """Say whether a name calls it a place or a state that has to be reached."""
    return bool(set(split_name(name)) & PLACE_WORDS)


def is_error(name: str) -> bool:
    """Say whether a term is a size that is better small, such as a distance."""
    words = set(split_name(name))
    return bool(words & (ERROR_WORDS | COST_WORDS | ACTION_WORDS)) and not words & OPPOSITE_WORDS


def is_about_steps(name: str) -> bool:
    """Say whether a term is about feet in the air: their clearance, or how long they are there."""
    words = set(split_name(name))
    is_lift = bool(words & STEPPING_WORDS) or {"air", "time"} <= words or ("height" in words and _has_feet(words))
    return is_lift and not words & COST_WORDS and not words & GRASP_WORDS


def is_about_landings(name: str) -> bool:
    """Say whether a term is about how long feet were in the air, which is known when they come down."""
    words = set(split_name(name))
    return is_about_steps(name) and bool(words & {"air", "airtime"})


def _has_feet(words: Collection[str]) -> bool:
    return bool(set(words) & {"foot", "feet"})


def is_about_grasps(name: str) -> bool:
    """Say whether a term pays that a gripper holds something."""
    words = set(split_name(name))
    return bool(words & GRASP_WORDS) and not words & (COST_WORDS | OPEN_WORDS | OPPOSITE_WORDS - {"bonus", "reward"})


def is_paid(name: str) -> bool:
    """Say whether a number of info is a term of the reward: one of a dictionary of them, or called so."""
    folder, _, term = name.rpartition("/")
    return bool({"reward", "rewards", "rew", "terms"} & {*split_name(folder or term)})
