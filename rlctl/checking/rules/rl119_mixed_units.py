"""RL119: mixed units."""

from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking import rewards
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.goals import SCALED_GOAL, ScaledGoal
from rlctl.checking.experiments.worlds import ObservedWorld, WatchedWorlds, judges_worlds
from rlctl.checking.joint_copies import DEGREES, JointCopy
from rlctl.checking.rates import Rate, find_rates
from rlctl.checking.readings import find_lengths, name_features, read_features
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable, Rule, RuleFinding, Severity, list_names
from rlctl.checking.transitions import collect_transitions
from rlctl.checking.worlds import Array

RULE = Rule(
    "RL119",
    "mixed units",
    Severity.WARNING,
    meaning="""
        An element of the observation changes in each step by another element, its rate, times a time; for
        another pair of elements this time is 1000, 100 or 57.3 times as long: one of them is in millimetres,
        centimetres or degrees, and the rest in metres or radians. In an environment with an engine, a time of
        more than 5 s tells the same, and so does a joint that is observed in degrees beside another one, or a
        speed, in radians, or a place that is exactly 100 or 1000 times the engine's. Networks then see the other
        elements as if they were 0, and sums of both in a reward mean nothing.
    """,
    fix="Use metres, radians and seconds everywhere.",
)

MOST_ROWS = 2_000
UNITS = (
    (1000.0, 0.03, 0.0, "millimetres and metres"),
    (100.0, 0.03, 5.0, "centimetres and metres"),
    (180 / np.pi, 0.015, 0.0, "degrees and radians"),
)
"""How many times a number is larger in the smaller unit, its tolerance, the least root mean square of what is in it,
and the two units."""
LENGTHS = ((1000.0, "millimetres"), (100.0, "centimetres"))
LEAST_LARGE = 5.0  # root mean square of what is observed in such a unit: smaller numbers are normalised on purpose
EXACT = 1e-5  # relative; the last bits of float32 after a division
FIRST_LOOKS = 6  # Values that differ in these are not compared further
LEAST_MOTION = 1e-3  # of what is observed in such a unit: its standard deviation, in the engine's [m]
LONGEST_STEP = 5.0  # of an engine: no robot is controlled so rarely [s]
LARGE = 100.0  # root mean square of what is in millimetres


@judges_records(RULE, *rewards.WITH_SEARCH, "worlds", "goals")  # "worlds" compares with the state of the engine
def _find_mixed_units(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    scaled: ScaledGoal | None = records.facts.get(SCALED_GOAL)
    if scaled is not None and scaled.size >= LEAST_LARGE:
        yield _describe_scaled(scaled)
        return
    steps = collect_transitions(records)
    steps = steps.select(np.arange(0, len(steps.rewards), max(1, len(steps.rewards) // MOST_ROWS)))
    pairs = sorted(find_rates(steps), key=lambda pair: pair.seconds)
    if not pairs:
        raise NotApplicable("no element of the observation is the rate of another")
    for short in pairs:
        for long in pairs:
            for factor, tolerance, least_size, units in UNITS:
                is_factor = abs(long.seconds / short.seconds / factor - 1) < tolerance
                if is_factor and long.size >= least_size:
                    other = f"{short.quantity} by {short.seconds:.4g} times {short.rate}, {factor:.4g} times less"
                    yield _finding(long, f"{other}: {units}")
                    return
    longest = pairs[-1]
    if (built.uses_pybullet or built.model) and longest.seconds > LONGEST_STEP and longest.size > LARGE:
        yield _finding(longest, f"a step of the simulation would take {longest.seconds:.3g} s: millimetres and metres")


def _describe_scaled(goal: ScaledGoal) -> RuleFinding:
    name, unit = f"observation[{goal.element}]", dict(LENGTHS)[goal.factor]
    message = f"{name} follows {goal.name} times {goal.factor:g}: {unit}, if that is in metres"
    return RuleFinding(RULE, message, {"element": name, "value": goal.factor, "expected": 1.0})


def _finding(pair: Rate, why: str) -> RuleFinding:
    message = f"{pair.quantity} changes in a step by {pair.seconds:.4g} times {pair.rate}; {why}"
    return RuleFinding(RULE, message, {"element": pair.quantity, "value": pair.seconds})


@judges_worlds(RULE, decides=False)
def _find_degrees(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in watched.observed:
        yield from _find_copies_in_degrees(one.copies)
        yield from _find_places_in_small_units(one)


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


def _find_places_in_small_units(one: ObservedWorld) -> Iterator[RuleFinding]:
    """Yield an element that is a place or a velocity of the engine times 100 or 1000, but for its episode's constant,
    where another element is exactly what the engine has."""
    sizes = [len(log.observed) for log in one.logs]
    looks = [read_features(log, *look) for log in one.logs for look in zip(log.states, log.poses, strict=True)]
    features, observed = _center(np.stack(looks), sizes), _center(one.observed, sizes)
    moves, are_large = features.std(axis=0) > LEAST_MOTION, np.sqrt(np.mean(np.square(one.observed), axis=0))
    columns = np.flatnonzero(are_large >= LEAST_LARGE)
    if not columns.size or not _find_equal(features[:, moves], observed, 1.0):
        return
    lengths = np.flatnonzero(find_lengths(one.logs[0]) & moves)
    for factor, unit in LENGTHS:
        for place, number in _find_equal(features[:, lengths], observed[:, columns], factor):
            what, name = name_features(one.logs[0])[int(lengths[place])], f"observation[{columns[number]}]"
            message = f"{name} follows the {what} times {factor:g}: {unit}; other elements are in the engine's units"
            yield RuleFinding(RULE, message, {"element": name, "value": factor, "expected": 1.0})
            return


def _center(values: Array, sizes: Sequence[int]) -> Array:
    """Subtract from the rows of each episode, which have the given sizes, their first one."""
    starts = np.cumsum([0, *sizes[:-1]])
    return values - np.repeat(values[starts], sizes, axis=0)


def _find_equal(features: Array, observed: Array, factor: float) -> list[tuple[int, int]]:
    """Return the pairs of a feature and a column that is the feature times a factor, or its opposite."""
    few = np.linspace(1, len(observed) - 1, FIRST_LOOKS).astype(int)
    found: list[tuple[int, int]] = []
    for signed in (factor, -factor):
        off = np.abs(observed[few][:, None, :] - signed * features[few][:, :, None])
        allowed = EXACT * (np.abs(observed).max(axis=0) + np.abs(factor * features).max(axis=0)[:, None])
        for feature, column in np.argwhere((off <= allowed).all(axis=0)).tolist():
            rest = np.abs(observed[:, column] - signed * features[:, feature]).max()
            if rest <= allowed[feature, column]:
                found.append((feature, column))
    return found
