"""RL119: mixed units."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking import rewards
from rlctl.checking.engine_values import LEAST_MOTION, NOISY, NOISY_FACTOR, ScaledValue, center, explain
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import AttributeLog
from rlctl.checking.experiments.goals import SCALED_GOAL, ScaledGoal
from rlctl.checking.experiments.worlds import ObservedWorld, WatchedWorlds, judges_worlds
from rlctl.checking.rates import Rate, find_rates
from rlctl.checking.records import Built, Records
from rlctl.checking.rule import NotApplicable, Rule, RuleFinding, Severity, list_others
from rlctl.checking.step_times import find_rates as find_attribute_rates
from rlctl.checking.transitions import collect_transitions, list_float_parts, name_floats
from rlctl.checking.values import name_numbers
from rlctl.checking.worlds import Array

RULE = Rule(
    "RL119",
    "mixed units",
    Severity.WARNING,
    meaning="""
        An element of the observation changes in each step by another element, its rate, times a time; for
        another pair of elements this time is 1000, 100 or 57.3 times as long: one of them is in millimetres,
        centimetres or degrees, and the rest in metres or radians. In an environment with an engine, a time of
        more than 5 s tells the same, and so does an element that is a value of the engine times such a number,
        with noise or without, beside another one that is in the engine's unit: an angle, a place, or the velocity
        or angular velocity of a joint, a link or a body. So does an attribute times such a number, beside its own rate
        in the larger unit. Networks then see the other elements as if they were 0, and sums of both in a reward mean
        nothing.
    """,
    fix="Use metres, radians and seconds everywhere.",
)

MOST_ROWS = 2_000


@dataclasses.dataclass(frozen=True)
class UnitRatio:
    """How many numbers of a smaller unit are one of the unit that rlctl and the engines have."""

    factor: float
    small: str
    large: str
    tolerance: float  # of times that are estimated, relative
    least_size: float = 0.0  # root mean square of what is observed in it; smaller numbers are normalised on purpose
    is_angle: bool = False


UNITS = (
    UnitRatio(1000.0, "millimetres", "metres", 0.03),
    UnitRatio(100.0, "centimetres", "metres", 0.03, least_size=5.0),
    UnitRatio(180 / np.pi, "degrees", "radians", 0.015, is_angle=True),
)
LEAST_LARGE = 5.0  # the same for lengths that follow a goal or the engine
LONGEST_STEP = 5.0  # of an engine: no robot is controlled so rarely [s]
LARGE = 100.0  # root mean square of what is in millimetres


@judges_records(
    RULE, *rewards.WITH_SEARCH, "worlds", "goals", "attributes"
)  # "worlds" compares with the state of the engine
def _find_mixed_units(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    if any(finding.rule == RULE.id for finding in records.findings):
        return  # the engine's values have told it
    scaled: ScaledGoal | None = records.facts.get(SCALED_GOAL)
    if scaled is not None and scaled.size >= LEAST_LARGE:
        yield _describe_scaled(scaled, built)
        return
    log: AttributeLog | None = records.facts.get("attributes")
    if log is not None and (scaled_pair := _find_scaled_pair(log)) is not None:
        yield _describe_pair(scaled_pair, name_floats(built.leaves))
        return
    steps = collect_transitions(records)
    steps = steps.select(np.arange(0, len(steps.rewards), max(1, len(steps.rewards) // MOST_ROWS)))
    pairs = sorted(find_rates(steps), key=lambda pair: pair.seconds)
    if not pairs:
        raise NotApplicable("no element of the observation is the rate of another")
    for short in pairs:
        for long in pairs:
            for unit in UNITS:
                is_factor = abs(long.seconds / short.seconds / unit.factor - 1) < unit.tolerance
                if is_factor and long.size >= unit.least_size and not _are_mixed_up(short, long):
                    other = f"{short.quantity} by {short.seconds:.4g} times {short.rate}, {unit.factor:.4g} times less"
                    yield _finding(long, f"{other}: {unit.small} and {unit.large}")
                    return
    longest = pairs[-1]
    if (built.uses_pybullet or built.model) and longest.seconds > LONGEST_STEP and longest.size > LARGE:
        yield _finding(longest, f"a step of the simulation would take {longest.seconds:.3g} s: millimetres and metres")


def _are_mixed_up(one: Rate, other: Rate) -> bool:
    """Say whether the speed of one is a part of the place of the other: they fit by chance."""
    pairs = ((one.rate.strip("|"), other.quantity), (other.rate.strip("|"), one.quantity))
    return any(rate in quantity and rate != quantity for rate, quantity in pairs)


@dataclasses.dataclass(frozen=True)
class _ScaledPair:
    """Two elements that are attributes in different units, of which one changes by the other."""

    small: int  # The element in the small unit
    large: int
    unit: UnitRatio
    small_name: str  # of its attribute
    large_name: str


def _find_scaled_pair(log: AttributeLog) -> _ScaledPair | None:
    """Return such a pair, with noise or without."""
    sizes = np.unique(log.episodes, return_counts=True)[1].tolist()
    observed, values = center(log.observed, sizes), center(log.values, sizes)

    def find_element(attribute: int, factor: float) -> int | None:
        """Return the element that is an attribute times a factor."""
        is_known = values[:, attribute].std() > LEAST_MOTION
        for column in np.flatnonzero(observed.std(axis=0) > 0).tolist() if is_known else ():
            factors, left = explain(observed[:, [column]], values[:, [attribute]])
            if left[0, 0] < NOISY and np.isclose(abs(factors[0, 0]), factor, rtol=NOISY_FACTOR):
                return int(column)
        return None

    for place, rate, _ in find_attribute_rates(log, log.values):
        for small, large in ((place, rate), (rate, place)):
            for unit in UNITS:
                one, two = find_element(small, unit.factor), find_element(large, 1.0)
                is_large = one is not None and np.abs(log.observed[:, one]).max() > unit.least_size
                if one is not None and two is not None and is_large:
                    return _ScaledPair(one, two, unit, log.names[small], log.names[large])
    return None


def _describe_pair(pair: _ScaledPair, names: Sequence[str]) -> RuleFinding:
    name = names[pair.small]
    message = f"{name} is {pair.small_name} times {pair.unit.factor:.4g}, and {names[pair.large]} is {pair.large_name},"
    message += f" of which one changes by the other: {pair.unit.small} and {pair.unit.large}"
    return RuleFinding(RULE, message, {"element": name, "value": pair.unit.factor, "expected": 1.0})


def _describe_scaled(goal: ScaledGoal, built: Built) -> RuleFinding:
    name = name_numbers(list_float_parts(built.leaves), goal.element)
    small = next(unit.small for unit in UNITS if unit.factor == goal.factor)
    message = f"{name} follows {goal.name} times {goal.factor:g}: {small}, if that is in metres"
    return RuleFinding(RULE, message, {"element": name, "value": goal.factor, "expected": 1.0})


def _finding(pair: Rate, why: str) -> RuleFinding:
    message = f"{pair.quantity} changes in a step by {pair.seconds:.4g} times {pair.rate}; {why}"
    return RuleFinding(RULE, message, {"element": pair.quantity, "value": pair.seconds})


@judges_worlds(RULE, decides=False)
def _find_small_units(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in [*watched.observed, *watched.thrown]:
        sizes = np.sqrt(np.mean(np.square(one.observed), axis=0))
        for unit in UNITS:
            small = [scaled for scaled in one.scaled if _is_in_unit(scaled, unit, sizes)]
            plain = [scaled for scaled in one.scaled if scaled.has_factor(1.0) and _is_beside(scaled, unit)]
            if small and plain:
                yield _describe_small(one, small, plain[0], unit)
                return


def _is_in_unit(scaled: ScaledValue, unit: UnitRatio, sizes: Array) -> bool:
    is_kind = scaled.value.is_angle == unit.is_angle and scaled.has_factor(unit.factor)
    return is_kind and (unit.is_angle or float(sizes[scaled.column]) >= LEAST_LARGE)


def _is_beside(scaled: ScaledValue, unit: UnitRatio) -> bool:
    """Say whether an element in the engine's unit shows that the small unit is not meant: degrees beside metres may be,
    and degrees beside radians or speeds are not."""
    return not unit.is_angle or scaled.value.is_angle or scaled.value.is_speed


def _describe_small(
    one: ObservedWorld, small: Sequence[ScaledValue], plain: ScaledValue, unit: UnitRatio
) -> RuleFinding:
    names, value = [one.name_element(scaled.column) for scaled in small], small[0].value
    name, others = names[0], list_others(names)
    base = "rad" if plain.value.is_angle else "m"
    other_unit = f"{base}/s" if plain.value.is_speed else base
    other = f"{one.name_element(plain.column)}, the {plain.value.name}, is in {other_unit}"
    small_unit = f"{unit.small} per second" if value.is_speed else unit.small
    what = f"{name} is the {value.name}, in {small_unit}{others}"
    message = f"{what}: it is {unit.factor:.4g} times the engine's, and {other}"
    return RuleFinding(RULE, message, {"element": name, "value": small[0].factor, "expected": 1.0})
