"""RL812 and RL817 of MuJoCo: which parts of the model an environment looks up and changes."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rlctl.checking.instance import EnvironmentRaised, Instance
from rlctl.checking.mujoco_calls import MujocoCalls
from rlctl.checking.mujoco_trials import Look, name_columns, pair_rows, play
from rlctl.checking.mujoco_worlds import MujocoStateReader
from rlctl.checking.records import FIRST_SEED, SECOND_SEED
from rlctl.checking.rule import RuleFinding, list_names
from rlctl.checking.worlds import Array
from rlctl.environments.info import find_mujoco

PROPERTIES = {
    "body_mass": "body", "body_inertia": "body", "geom_friction": "geom", "dof_damping": "", "dof_armature": "",
    "dof_frictionloss": "", "jnt_stiffness": "joint", "actuator_gainprm": "actuator", "actuator_biasprm": "actuator",
    "actuator_gear": "actuator", "opt.gravity": "",
}  # fmt: skip
"""Arrays of the model that are randomised."""
SCALED = 1.5
RESETS = 6
CONTACT_STEPS = 60
NEVER, OFTEN = 0.02, 0.1  # Parts of all looks in which something touches
MOST_COUNTS = 9  # So many different values has a number of contacts


def _read_properties(model: Any) -> dict[str, Array]:
    owners = {name: (model.opt if name.startswith("opt.") else model) for name in PROPERTIES}
    return {name: getattr(owner, name.removeprefix("opt.")).copy() for name, owner in owners.items()}


def _write_property(model: Any, name: str, values: Array) -> None:
    owner = model.opt if name.startswith("opt.") else model
    getattr(owner, name.removeprefix("opt."))[:] = values


def find_drift(instance: Instance) -> Iterator[RuleFinding]:
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
            row = int(np.argwhere(grown)[0][0])
            kind = PROPERTIES[name]
            of = f" ({getattr(model, kind)(row).name or row})" if kind else ""
            series = ", ".join(f"{float(np.ravel(each[name][row])[-1]):.4g}" for each in drawn)
            message = f"every reset changes model.{name} as the last one left it: {name}[{row}]{of} was {series}"
            evidence = {"element": f"model.{name}", "call": "reset", "seed": FIRST_SEED}
            yield RuleFinding("RL817", message, evidence)


def find_untouched_parts(instance: Instance, calls: MujocoCalls, reader: MujocoStateReader) -> Iterator[RuleFinding]:
    """Yield parts that the environment looks up by name and that touch nothing, while their neighbours do, if flags in
    the observation, or a part of the reward, wait for these contacts."""
    plain: list[Look] = []
    for kind in ("geom", "body"):
        if swapped := _find_neighbours(calls, reader, kind):
            plain = plain or play(instance, calls, CONTACT_STEPS)
            columns, size = _play_swapped(instance, calls, kind, swapped, plain)
            if columns == [size] and any((kind, other) in calls.asked for other, _ in swapped.values()):
                columns = []  # the reward may count the neighbour's contacts, too
            if columns:
                yield _untouched(kind, swapped, name_columns(columns, size), name_columns(columns[:1], size))
                return


def _play_swapped(
    instance: Instance, calls: MujocoCalls, kind: str, swapped: dict[str, tuple[str, float]], plain: Sequence[Look]
) -> tuple[list[int], int]:
    """Return the flags that begin to change where parts are their neighbours, and the observation's size."""
    calls.other_names = {(kind, name): other for name, (other, _) in swapped.items()}
    try:
        with instance.context.fresh() as another:
            changed = play(another, calls, CONTACT_STEPS)
    except EnvironmentRaised:  # it needs something of the part that its neighbour does not have
        return [], 0
    finally:
        calls.other_names = {}
    pair = pair_rows(plain, changed)
    return ([], 0) if pair is None else (_find_flags(*pair), pair[0].shape[1] - 1)


def _untouched(kind: str, swapped: dict[str, tuple[str, float]], elements: str, first: str) -> RuleFinding:
    name, (other, part) = next(iter(swapped.items()))
    waits = f"{elements} {'are' if ',' in elements else 'is'} about contacts of {kind} {list_names(list(swapped), 4)}"
    touches = f"{name} touches nothing, but its neighbour {other} does in {100 * part:.0f} % of all steps"
    return RuleFinding("RL812", f"{waits}: {touches}", {"element": first, "value": name, "expected": other})


def _find_flags(plain: Array, changed: Array) -> list[int]:
    """Return columns that are 0 and become 0 or 1, and the reward if it differs by few values. A column that becomes
    what another one is already is left out: the environment observes the neighbour, too."""
    flags = [
        column
        for column in range(plain.shape[1] - 1)
        if not plain[:, column].any()
        and set(np.unique(changed[:, column])) == {0.0, 1.0}
        and not (plain == changed[:, [column]]).all(axis=0).any()
    ]
    differences = np.unique(np.round(changed[:, -1] - plain[:, -1], 6))
    others = [c for c in range(plain.shape[1] - 1) if c not in flags and not np.array_equal(plain[:, c], changed[:, c])]
    is_counted = not others and 1 < len(differences) <= MOST_COUNTS and 0.0 in differences
    return [*flags, *([plain.shape[1] - 1] if is_counted else [])]


def _find_neighbours(calls: MujocoCalls, reader: MujocoStateReader, kind: str) -> dict[str, tuple[str, float]]:
    """Return, for each geom or body that was looked up and hardly ever touches anything, the neighbour that does most
    often, and in which part of all looks; empty where that is not often."""
    model, looks = reader.model, reader.touched
    rates = np.zeros(model.ngeom)
    for touched in looks:
        rates[list(touched)] += 1.0 / len(looks)
    bodies, swapped = model.geom_bodyid, {}
    for name in [name for asked, name in calls.asked if asked == kind]:
        if not (part := _find_part(model, kind, name)):
            continue
        near = _find_near(model, int(bodies[part]) if kind == "geom" else part)
        if kind == "geom":
            rate_of = {geom: float(rates[geom]) for geom in np.flatnonzero(np.isin(bodies, near)).tolist()}
        else:
            rate_of = {body: float(rates[bodies == body].max(initial=0.0)) for body in near}
        own = rate_of.pop(part, 1.0)  # a geom of the world itself is among none of them
        names = {getattr(model, kind)(other).name: rate for other, rate in rate_of.items()}
        best = max((other for other in names if other), key=lambda other: names[other], default="")
        if own <= NEVER and best and names[best] >= OFTEN:
            swapped[name] = best, names[best]
    return swapped


def _find_near(model: Any, body: int) -> list[int]:
    """Return a body, its parent, its siblings and what is beyond it; not the world."""
    parents = model.body_parentid
    near = {body, int(parents[body])} | set(np.flatnonzero(parents == parents[body]).tolist())
    beyond = {body}
    for other in range(body + 1, model.nbody):  # children come after their parents
        if int(parents[other]) in beyond:
            beyond.add(other)
    return sorted((near | beyond) - {0})


def _find_part(model: Any, kind: str, name: str) -> int:
    try:
        return int(getattr(model, kind)(name).id)
    except KeyError:
        return 0
