"""RL119: mixed units."""

from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking import rewards
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.joint_copies import DEGREES, JointCopy
from rlctl.checking.rates import Rate, find_rates
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable, Rule, RuleFinding, Severity, list_names
from rlctl.checking.transitions import collect_transitions

RULE = Rule(
    "RL119",
    "mixed units",
    Severity.WARNING,
    meaning="""
        An element of the observation changes in each step by another element, its rate, times a time; for
        another pair of elements this time is 1000 times as long, or 57.3 times: one of them is in millimetres
        or degrees, and the rest in metres or radians. In an environment with an engine, a time of more than 5 s
        tells the same, and so does a joint that is observed in degrees beside another one, or a speed, in
        radians. Networks then see the other elements as if they were 0, and sums of both in a reward mean
        nothing.
    """,
    fix="Use metres, radians and seconds everywhere.",
)

MOST_ROWS = 2_000
UNITS = ((1000.0, 0.03, "millimetres and metres"), (180 / np.pi, 0.015, "degrees and radians"))
"""How many times a number is larger in the smaller unit, its tolerance, and the two units."""
LONGEST_STEP = 5.0  # of an engine: no robot is controlled so rarely [s]
LARGE = 100.0  # root mean square of what is in millimetres


@judges_records(RULE, *rewards.WITH_SEARCH, "worlds")  # which compares joints with those of the engine
def _find_mixed_units(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    steps = collect_transitions(records)
    steps = steps.select(np.arange(0, len(steps.rewards), max(1, len(steps.rewards) // MOST_ROWS)))
    pairs = sorted(find_rates(steps), key=lambda pair: pair.seconds)
    if not pairs:
        raise NotApplicable("no element of the observation is the rate of another")
    for short in pairs:
        for long in pairs:
            for factor, tolerance, units in UNITS:
                if abs(long.seconds / short.seconds / factor - 1) < tolerance:
                    other = f"{short.quantity} by {short.seconds:.4g} times {short.rate}, {factor:.4g} times less"
                    yield _finding(long, f"{other}: {units}")
                    return
    longest = pairs[-1]
    if (built.uses_pybullet or built.model) and longest.seconds > LONGEST_STEP and longest.size > LARGE:
        yield _finding(longest, f"a step of the simulation would take {longest.seconds:.3g} s: millimetres and metres")


def _finding(pair: Rate, why: str) -> RuleFinding:
    message = f"{pair.quantity} changes in a step by {pair.seconds:.4g} times {pair.rate}; {why}"
    return RuleFinding(RULE, message, {"element": pair.quantity, "value": pair.seconds})


@judges_worlds(RULE, decides=False)
def _find_degrees(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in watched.observed:
        yield from _find_copies_in_degrees(one.copies)


def _find_copies_in_degrees(copies: Sequence[JointCopy]) -> Iterator[RuleFinding]:
    large, plain = ([copy for copy in copies if copy.is_scaled(factor)] for factor in (DEGREES, 1.0))
    if large and plain:
        name, unit = f"observation[{large[0].column}]", "rad/s" if plain[0].is_speed else "rad"
        more = (
            f" (likewise {list_names([f'observation[{copy.column}]' for copy in large[1:]], 4)})" if large[1:] else ""
        )
        other = f"observation[{plain[0].column}], {plain[0].name}, is in {unit}"
        message = f"{name} is {large[0].name} in degrees{more}, and {other}"
        yield RuleFinding(RULE, message, {"element": name, "value": large[0].factor, "expected": 1.0})
