"""RL817: randomisation accumulates."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from rlctl.checking.experiments.worlds import judges_resets
from rlctl.checking.instance import Instance
from rlctl.checking.records import FIRST_SEED, SECOND_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.worlds import Array
from rlctl.environments.simulations import find_mujoco

RULE = Rule(
    "RL817",
    "randomisation accumulates",
    Severity.ERROR,
    meaning="""
        Every reset changes a property of the MuJoCo model, such as a mass or a friction, as the last reset left
        it, instead of its nominal value. Over many episodes it drifts away, and no episode can be repeated from
        its seed.
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
SCALED = 1.5
RESETS = 6


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
