"""RL836: limit is applied twice."""

import itertools
import math
from collections.abc import Collection, Iterator, Mapping

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import (
    EPISODES,
    AttributeLog,
    find_declared_numbers,
    find_weights,
)
from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable, Rule, RuleFinding, Severity
from rlctl.checking.term_names import split_name

RULE = Rule(
    "RL836",
    "limit is applied twice",
    Severity.WARNING,
    meaning="""
        What the action becomes, such as a torque, is the action times the square of a number that the source declares
        as its limit: a limit of 0.02 N m lets through 0.0004 N m, one of 20 N m asks for 400. The action was scaled
        before it was handed on, and was scaled there again. The check held an action until nothing changed any more, or
        compared the ends of the action with what the motors got.
    """,
    fix="Scale the action in one place, either where it is read or where the force is computed.",
)

LIMIT_WORDS = {"force", "gain", "limit", "max", "maximum", "power", "scale", "thrust", "torque"}
LAST = 4  # looks at which what follows a held action is settled
SAME = 1e-5  # relative, of float32 actions and of what is nearly settled
LEAST_ACTION = 0.02  # of the held action


@judges_records(RULE, "attributes")
def _find_squared_limits(records: Records) -> Iterator[RuleFinding]:
    """Yield the limit whose square an attribute is for each 1 of the action, in two elements at least."""
    log: AttributeLog = records.require_fact("attributes")
    limits = _list_squares(log.declared, {*log.literals, *map(abs, log.declared.values())})
    if not limits:
        raise NotApplicable("no limit of what the action does is declared")
    rows = np.flatnonzero(log.episodes == EPISODES.index("repeated"))[-LAST:]
    values, actions = log.values[rows], log.actions[rows]
    settled = [
        column
        for column in np.flatnonzero(values.any(axis=0)).tolist()
        if np.ptp(values[:, column]) <= SAME * np.abs(values[:, column]).max()
    ]
    for limit, square in limits.items():
        found = [
            (column, element)
            for column in settled
            for element, one in enumerate(actions[-1].tolist())
            if abs(one) > LEAST_ACTION and math.isclose(values[-1, column], square * one, rel_tol=SAME)
        ]
        for one, two in itertools.pairwise(found):
            if log.names[one[0]].rpartition("[")[0] == log.names[two[0]].rpartition("[")[0] and one[1] != two[1]:
                what = f"{log.names[one[0]]} settles at {square:.4g} times action[{one[1]}]"
                yield _describe(what, log.names[one[0]], limit, square)
                return


@judges_worlds(RULE)
def _find_squared_commands(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    """Yield the limit whose square a motor gets where the action is at its end."""
    env = watched.instance.env
    limits = _list_squares(find_declared_numbers(env), find_weights(env))
    for span in (span for _, spans in watched.driven for span in spans):
        for limit, square in limits.items():
            ends = {abs(float(end)) * square for end in (*watched.low, *watched.high) if np.isfinite(end)}
            if abs(span.high + span.low) <= SAME * abs(span.high) and any(
                math.isclose(span.high, end, rel_tol=SAME) for end in ends if end
            ):
                what = f"motor {span.motor.name} gets up to {span.high:.4g}"
                yield _describe(what, span.motor.name, limit, square)
                return


def _list_squares(declared: Mapping[str, float], numbers: Collection[float]) -> dict[str, float]:
    """Return the squares of limits by their names, without those that are another number of the source, or the product
    of two declared ones."""
    limits = {name: abs(value) for name, value in declared.items() if LIMIT_WORDS & {*split_name(name)}}
    own = {abs(value) for value in numbers}
    products = [one * two for one, two in itertools.combinations({abs(value) for value in declared.values()}, 2)]
    found: dict[str, float] = {}
    for name, limit in limits.items():
        others = [*(own - {limit}), *products]
        if limit not in (0.0, 1.0) and not any(math.isclose(limit**2, other, rel_tol=SAME) for other in others):
            found[name] = limit**2
    return found


def _describe(what: str, element: str, limit: str, square: float) -> RuleFinding:
    message = f"{what}: the square of {limit}, which is {math.sqrt(square):.4g}"
    return RuleFinding(RULE, message, {"element": element, "value": square, "expected": math.sqrt(square)})
