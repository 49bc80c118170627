"""RL817: randomisation accumulates."""

import ast
from collections.abc import Iterator
from typing import Any

import numpy as np

from rlctl.checking.assignments import Assignment, peel, read_key, read_words
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.worlds import judges_resets
from rlctl.checking.goal_draws import is_drawn
from rlctl.checking.instance import Instance
from rlctl.checking.left_overs import STATE_FIELDS
from rlctl.checking.records import FIRST_SEED, SECOND_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.source_code import write_code
from rlctl.checking.worlds import Array
from rlctl.environments.simulations import find_mujoco

RULE = Rule(
    "RL817",
    "randomisation accumulates",
    Severity.ERROR,
    meaning="""
        Every reset changes a property of the MuJoCo model, such as a mass or a friction, as the last reset left
        it, instead of its nominal value; or an attribute such as self.mass, which a line of reset multiplies by a
        draw, or adds one to, and which nothing sets back. Over many episodes it drifts away, and no episode can be
        repeated from its seed.
    """,
    fix="""
        Keep a copy of the nominal values, self.mass = model.body_mass.copy() in the constructor, and write
        model.body_mass[:] = self.mass * factor in reset.
    """,
)

PROPERTIES = {
    "body_mass": "body", "body_inertia": "body", "geom_friction": "geom", "dof_damping": "", "dof_armature": "",
    "dof_frictionloss": "", "jnt_stiffness": "joint", "actuator_gainprm": "actuator", "actuator_biasprm": "actuator",
    "actuator_gear": "actuator", "opt.gravity": "",
}  # fmt: skip
"""Arrays of the model that are randomised."""
LASTING_WORDS = {"level", "difficulty", "curriculum", "total", "count", "episode", "episodes", "seed"}
"""What is meant to go on over resets."""
SCALED = 1.5
RESETS = 6


@judges_expressions(RULE, decides=False)
def _judge_source(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    """Yield the first attribute that a reset computes from itself and a draw, and that nothing else sets."""
    assigned = noted.definitions.assigned
    for key, assignments in assigned.items():
        of_episodes = [one for one in assignments if one.function in {*noted.of_resets, *noted.of_steps}]
        owners = [other for other in assigned if key.startswith(f"{other}.")]
        is_rebuilt = any(one.function in noted.of_resets for owner in owners for one in assigned[owner])
        is_state = key.rpartition(".")[2] in STATE_FIELDS  # of MuJoCo, which mj_resetData sets back: else RL303
        if len(of_episodes) == 1 and not is_rebuilt and not is_state and not read_words(key) & LASTING_WORDS:
            (one,) = of_episodes
            if one.function in noted.of_resets and one.function.name != "__init__" and _grows(noted, one, key):
                message = f"{write_code(one.statement)}: each reset changes {key} as the last one has left it"
                place = noted.source.find_place(one.statement)
                yield RuleFinding(RULE, message, {"element": key, "call": "reset"}, Severity.WARNING, where=place)
                return


def _grows(noted: NotedEpisodes, one: Assignment, key: str) -> bool:
    """Say whether an attribute is multiplied by a draw, or gets one added."""
    if not is_drawn(noted.definitions, one.value, one.function):
        return False
    match one.statement, peel(one.value):
        case ast.AugAssign(), _:
            return True
        case ast.Assign(), ast.BinOp(left=left, right=right):
            return key in (read_key(left), read_key(right))
    return False


@judges_resets(RULE)
def _find_drift(instance: Instance) -> Iterator[RuleFinding]:
    """Reset with a property of the model as it was, and scaled: a reset from nominal values gives the same twice."""
    drawn = []
    simulation = find_mujoco(instance.env)
    for number in range(RESETS):
        instance.reset(FIRST_SEED + number)
        if (simulation := find_mujoco(instance.env)) is None:
            return
        drawn.append(_read_properties(simulation[0]))
    model = simulation[0] if simulation else None
    changing = [name for name in PROPERTIES if any(not np.array_equal(d[name], drawn[0][name]) for d in drawn)]

    def reset_from(name: str, values: Array) -> Array:
        _write_property(model, name, values)
        instance.reset(SECOND_SEED)
        return _read_properties(model)[name]

    for name in changing:
        before = drawn[-1][name]
        if (present := find_mujoco(instance.env)) is None or present[0] is not model:  # reset builds a new model
            return
        first, again, scaled = (reset_from(name, values) for values in (before, before, SCALED * before))
        _write_property(model, name, drawn[0][name])
        grown = (scaled != first) & (first != before)
        if np.array_equal(first, again) and grown.any():
            place = tuple(np.argwhere(grown)[0].tolist())
            kind, shown = PROPERTIES[name], f"{name}[{', '.join(map(str, place))}]"
            of = f" ({getattr(model, kind)(place[0]).name or place[0]})" if kind else ""
            series = ", ".join(f"{each[name][place]:.4g}" for each in drawn)
            message = f"every reset changes model.{name} as the last one left it: {shown}{of} was {series}"
            evidence = {"element": f"model.{name}", "call": "reset", "seed": FIRST_SEED}
            yield RuleFinding(RULE, message, evidence)


def _read_properties(model: Any) -> dict[str, Array]:
    owners = {name: (model.opt if name.startswith("opt.") else model) for name in PROPERTIES}
    return {name: getattr(owner, name.removeprefix("opt.")).copy() for name, owner in owners.items()}


def _write_property(model: Any, name: str, values: Array) -> None:
    owner = model.opt if name.startswith("opt.") else model
    getattr(owner, name.removeprefix("opt."))[:] = values
