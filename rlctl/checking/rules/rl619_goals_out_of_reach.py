"""RL619: goals out of reach."""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np

from rlctl.checking import rewards
from rlctl.checking.bounded_places import BoundReader
from rlctl.checking.compared_places import FIXED, MOSTLY_FIXED, Bound, ComparedPlaces
from rlctl.checking.drawn_goals import DrawnGoal, Numbers, Source, find_sources, read_place
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.records import Records
from rlctl.checking.regression import action_terms, fit_terms
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.transitions import Transitions, collect_transitions, sample_ordinary_steps
from rlctl.checking.workspaces import Reach, find_reach

RULE = Rule(
    "RL619",
    "goals out of reach",
    Severity.WARNING,
    meaning="""
        Some of the goals that reset draws are further away than the robot ever came, although it came equally
        far in many directions: the edge of its workspace. Those episodes cannot succeed, whatever is learned,
        and the success rate that can be reached is below 100 %. An error if all goals are too far, such as
        goals in millimetres. Or the source computes the reward from the distance of two places, or of the position
        of a joint and its goal, and one of them is further than the other one gets: by the limits of the joints,
        or by what the source clips.
    """,
    fix="""
        Draw goals inside the workspace: from random joint positions, or a smaller radius. Lengths are in
        metres.
    """,
)

MARGIN = 0.02  # part of the reach that the robot may get further
UNKNOWN_TOLERANCE = 0.1  # part of the reach
HARDLY_MOVES = 0.25  # part of the longest range of coordinates of the robot
VERY_FAR = 2.0  # times the reach
FEWEST_FAR, FEWEST_SUCCESSES = 2, 3


@judges_expressions(RULE, decides=False)
def _judge_source(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    """Yield a goal that is beyond where the robot gets along an axis, in several episodes."""
    reader = BoundReader(noted)
    found = (
        finding
        for places in reader.list_places()
        for bound in reader.list_bounds(places)
        for finding in _compare_with_bound(reader, places, bound)
    )
    yield from itertools.islice(found, 1)


def _compare_with_bound(reader: BoundReader, places: ComparedPlaces, bound: Bound) -> Iterator[RuleFinding]:
    tolerance, goals = reader.find_tolerance(places), reader.list_goals(places)
    sizes = np.nanmax(np.concatenate(places.robots), axis=0) - np.nanmin(np.concatenate(places.robots), axis=0)
    for axis, sign, end in bound.list_ends():
        is_still = sizes[axis] < HARDLY_MOVES * sizes.max()
        if tolerance is None and is_still:
            continue  # such as a hand that stays above the table
        allowed = UNKNOWN_TOLERANCE * sizes[axis] if tolerance is None else tolerance + MARGIN * sizes[axis]
        rows = [bound.wrap(axis, goal[np.isfinite(goal[:, axis]), axis]) for goal in goals]
        fixed = [row for row in rows if row.size and np.ptp(row) < FIXED]
        if len(fixed) < MOSTLY_FIXED * len(rows):
            continue  # it may come to the robot
        beyond = [max(0.0, float((sign * (row - end)).min())) for row in fixed]
        far = [one for one in beyond if one > allowed]
        are_all = len(far) == len(beyond)
        if len(far) >= FEWEST_FAR and not (are_all and tolerance is None):
            name, farthest = places.name(places.goal, axis), end + sign * max(far)
            message = f"{name} is out of reach in {len(far)} of {len(beyond)} episodes, up to {farthest:.4g}:"
            message += f" {places.name(places.robot, axis)} gets to {end:.4g} at most; {bound.how}"
            evidence = {"element": name, "value": farthest, "expected": end}
            severity = Severity.ERROR if are_all else None
            yield RuleFinding(RULE, message, evidence, severity, where=places.distance.expression.where)


@judges_records(RULE, *rewards.WITH_SEARCH, "goals")
def _find_goals_out_of_reach(records: Records) -> Iterator[RuleFinding]:
    rewards.require_rewarded(records)
    drawn: DrawnGoal = records.require_fact("goals")
    if not drawn.place.is_place:
        raise NotApplicable("the goal is no place")
    steps = collect_transitions(records, with_constants=True)
    steps = steps.select(np.isin(steps.seeds, list(drawn.goals)))
    goals = np.array([drawn.goals[seed] for seed in steps.seeds.tolist()])
    try:
        places, of, tolerance = _find_robot(steps, goals, drawn)
        reach = drawn.reaches.get(of) or find_reach(places, steps.episodes)
    except (NotJudged, NotApplicable):
        # Rewards may not tell where the robot is; that a link is observed relative to goals far away tells enough.
        known, tolerance = [reach for (_, sign), reach in drawn.reaches.items() if sign], None
        if not known or _measure_distances(drawn, known[0]).min() < VERY_FAR * known[0].distance:
            raise
        reach = known[0]
    if tolerance is None:
        tolerance = UNKNOWN_TOLERANCE * reach.distance
    distances = _measure_distances(drawn, reach)
    far = distances > (1 + MARGIN) * reach.distance + tolerance
    if far.sum() >= FEWEST_FAR:
        seed, farthest = list(drawn.goals)[int(distances.argmax())], float(distances.max())
        centre = (np.round(reach.centre, 3) + 0.0).tolist()  # no -0.0
        where = f"up to {farthest:.4g}{reach.unit} from {centre}"
        goals_far = f"{int(far.sum())} of {len(far)} goals ({drawn.name}) are out of reach"
        message = f"{goals_far}: they are {where}; {reach.how}"
        expected = f"up to {reach.distance + tolerance:.4g}"
        evidence = {"element": drawn.name, "seed": seed, "value": farthest, "expected": expected}
        yield RuleFinding(RULE, message, evidence, Severity.ERROR if far.all() else None)


def _measure_distances(drawn: DrawnGoal, reach: Reach) -> Numbers:
    """Return how far the goals are from the centre of a reach. Shape (goals,)."""
    return np.linalg.norm(np.array(list(drawn.goals.values())) - np.array(reach.centre), axis=1)


def _find_robot(steps: Transitions, goals: Numbers, drawn: DrawnGoal) -> tuple[Numbers, Source, float | None]:
    """Return where what has to reach the goal is after each step, where that was read, and at what distance it is a
    success; None if no success was seen. Shape of the places: (n, size). Raises `NotJudged` if it is not observed."""
    if steps.success.all():
        raise NotJudged("every step is a success")
    first = steps.episodes == steps.episodes[0]
    read = {source: read_place(source, steps.after, goals) for source in find_sources(drawn.copies, steps.after, goals)}
    moving = {source: places for source, places in read.items() if np.ptp(places[first], axis=0).any()}
    is_relative = any(sign for _, sign in moving)
    for source, places in moving.items():
        if is_relative and not source[1]:
            continue
        distances = np.linalg.norm(places - goals, axis=1)
        reached, rest = distances[steps.success], distances[~steps.success]
        if len(reached) >= (1 if is_relative else FEWEST_SUCCESSES) and reached.max() < rest.min():
            return places, source, float(reached.max() + rest.min()) / 2
        chosen = sample_ordinary_steps(dataclasses.replace(steps, before=distances[:, None]))
        terms = np.hstack([action_terms(chosen), chosen.before, np.square(chosen.before)])
        if np.ptp(chosen.rewards) > 0 and fit_terms(terms, chosen.rewards).is_exact:
            return places, source, None
    raise NotJudged("the distance between the goal and the robot is not observed")
