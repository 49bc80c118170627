"""RL619: goals out of reach."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import rewards
from rlctl.checking.episode import EpisodePlayer, Moment
from rlctl.checking.experiment import PROBE, experiment, judges_records
from rlctl.checking.experiments.episodes import EPISODES
from rlctl.checking.experiments.starts import FIRST, STARTS
from rlctl.checking.instance import Context, Instance
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage, Fact, Records
from rlctl.checking.regression import action_terms, fit_terms
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.transitions import Transitions, collect_transitions, find_float_leaves, sample_ordinary_steps
from rlctl.checking.values import Attribute, read_attributes
from rlctl.checking.workspaces import Reach, find_chains, find_reach, measure_reach
from rlctl.environments.leaves import pick

RULE = Rule(
    "RL619",
    "goals out of reach",
    Severity.WARNING,
    meaning="""
        Some of the goals that reset draws are further away than the robot ever came, although it came equally
        far in many directions: the edge of its workspace. Those episodes cannot succeed, whatever is learned,
        and the success rate that can be reached is below 100 %. An error if all goals are too far, such as
        goals in millimetres.
    """,
    fix="""
        Draw goals inside the workspace: from random joint positions, or a smaller radius. Lengths are in
        metres.
    """,
)

SIZES = (1, 2, 3)  # of a place [numbers]
MOST_CANDIDATES = 6
STEPS = 3  # in which a goal does not change
SHIFT = np.array([0.013, -0.021, 0.034])  # of a goal, to see what of the observation follows it
ROUNDING, PART = 1e-5, 5e-7  # of observations to float32, and of large ones
COMPARED = 4  # resets after which the places of links are compared with the observation
NEAR = 2e-3  # how near they are [m]
MARGIN = 0.02  # part of the reach that the robot may get further
UNKNOWN_TOLERANCE = 0.1  # part of the reach
VERY_FAR = 2.0  # times the reach
FEWEST_FAR, FEWEST_SUCCESSES = 2, 3
Numbers = NDArray[np.float64]
Source = tuple[int, int]
"""The element of an observation from which on it has a place, and the sign with which the goal is in it, or 0."""


@experiment("goals", PROBE, 110, share=0.5)
def find_goals(context: Context) -> Iterator[ChildMessage]:
    """Find an attribute that is drawn at reset and stays, and the parts of the observation that follow it."""
    instance = context.instance
    if not instance.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    names, by_chance = _find_drawn(instance)
    for name in names:
        if copies := _find_copies(instance, name):
            goals: dict[int, list[float]] = {}
            for seed in [*range(FIRST_SEED, FIRST_SEED + len(EPISODES)), *range(FIRST, FIRST + STARTS)]:
                if context.budget.why_spent():
                    break
                instance.reset(seed)
                goals[seed] = read_attributes(instance.env)[name].numbers.tolist()
            reaches = _find_reaches(instance, name, copies)
            yield Fact("goals", DrawnGoal(name, copies, goals, reaches))
            return
    if by_chance:
        raise NotJudged("the seed does not determine what reset draws (RL301)")
    raise NotApplicable("the observation follows no attribute that reset draws")


def _find_drawn(instance: Instance) -> tuple[list[str], list[str]]:
    """Return the attributes of the size of a place that a reset draws by its seed and no step changes, and the others
    that it draws."""
    again, *drawn = (_read_after_reset(instance, seed) for seed in (FIRST_SEED, FIRST_SEED, SECOND_SEED))
    names = [name for name in drawn[0].keys() & drawn[1].keys() if _is_place(drawn[0][name], drawn[1][name])]
    seeded = [name for name in names if name in again and np.array_equal(again[name].numbers, drawn[0][name].numbers)]
    by_chance = sorted({*names} - {*seeded})
    if not seeded:
        return [], by_chance
    for _ in EpisodePlayer(instance, SECOND_SEED, max_steps=STEPS):
        pass
    after = read_attributes(instance.env)
    stays = [name for name in seeded if name in after and np.array_equal(after[name].numbers, drawn[1][name].numbers)]
    return sorted(stays)[:MOST_CANDIDATES], by_chance


def _read_after_reset(instance: Instance, seed: int) -> dict[str, Attribute]:
    EpisodePlayer(instance, seed, max_steps=0).reset()
    return read_attributes(instance.env)


def _is_place(one: Attribute, two: Attribute) -> bool:
    if np.asarray(one.value).dtype.kind != "f":
        return False  # whole numbers are states and cells: an environment looks them up in tables
    sizes = one.numbers.size, two.numbers.size
    return sizes[0] == sizes[1] and sizes[0] in SIZES and int((one.numbers != two.numbers).sum()) >= min(2, sizes[0])


def _find_copies(instance: Instance, name: str) -> list[tuple[int, int]]:
    """Return where the observation has the place, or its difference to something, and with which sign."""
    plain, shifted = (_observe(instance, name, shift) for shift in (0.0, 1.0))
    if plain.shape != shifted.shape:
        return []
    change, shift = shifted - plain, SHIFT[: read_attributes(instance.env)[name].numbers.size]
    parts = [change[element : element + len(shift)] for element in range(len(change) - len(shift) + 1)]
    rounding = [ROUNDING + PART * np.abs(plain[i : i + len(shift)]).max() for i in range(len(parts))]
    return [
        (i, sign) for i, part in enumerate(parts) for sign in (1, -1) if np.abs(part - sign * shift).max() < rounding[i]
    ]


def _observe(instance: Instance, name: str, shift: float) -> Numbers:
    """Return the observation of the first step if the place is shifted before it. Shape (elements,)."""
    episode = EpisodePlayer(instance, FIRST_SEED, "zero", max_steps=1)
    episode.reset()
    attribute = read_attributes(instance.env)[name]
    moved = attribute.numbers + shift * SHIFT[: attribute.numbers.size]
    attribute.assign(_like(attribute.value, moved))
    return _flatten(instance, episode.step())


def _like(value: Any, numbers: Numbers) -> Any:
    """Return numbers in the form of a value: an array, a list, a tuple or a number."""
    if isinstance(value, np.ndarray):
        return numbers.reshape(value.shape)
    return type(value)(numbers.tolist()) if isinstance(value, list | tuple) else float(numbers[0])


def _flatten(instance: Instance, moment: Moment) -> Numbers:
    leaves = [instance.leaves[index] for index in find_float_leaves(instance.leaves)]
    parts = [np.ravel(pick(moment.observation, leaf.path)) for leaf in leaves]
    return np.concatenate([np.zeros(0), *parts])


def _find_reaches(instance: Instance, name: str, copies: Sequence[Source]) -> dict[Source, Reach]:
    """Return how far the links of fixed robots get whose places are observed, by where they are observed."""
    rows, goals, links = [], [], []
    for seed in range(FIRST_SEED, FIRST_SEED + COMPARED):
        rows.append(_flatten(instance, EpisodePlayer(instance, seed, max_steps=0).reset()))
        goals.append(read_attributes(instance.env)[name].numbers)
        chains = list(find_chains(instance.env))
        if not chains:
            return {}
        links.append([chain.read() for chain in chains])
    observed, drawn = np.array(rows), np.array(goals)
    reaches: dict[Source, Reach] = {}
    for source in find_sources(copies, observed, drawn):
        places = read_place(source, observed, drawn)
        for number, chain in enumerate(chains):
            off = np.abs(np.array([one[number] for one in links])[:, :, : drawn.shape[1]] - places[:, None])
            link = int(off.max(axis=(0, 2)).argmin())
            if off[:, link].max() < NEAR and source not in reaches:
                reach = measure_reach(chain, link, drawn.shape[1])
                # A goal minus itself is the origin, where the base of many robots is.
                reaches |= {source: reach} if reach.distance > NEAR else {}
    return reaches


@dataclasses.dataclass(frozen=True)
class DrawnGoal:
    """A place that each reset draws."""

    name: str  # of the attribute
    copies: Sequence[Source]  # Where the observation has it, or its difference to something
    goals: Mapping[int, Sequence[float]]  # by seed
    reaches: Mapping[Source, Reach]  # of links of a fixed robot, by where the observation has their places


@judges_records(RULE, *rewards.WITH_SEARCH, "goals")
def _find_goals_out_of_reach(records: Records) -> Iterator[RuleFinding]:
    rewards.require_rewarded(records)
    if "goals" in records.not_applicable:
        raise NotApplicable(records.not_applicable["goals"])
    drawn: DrawnGoal = records.require_fact("goals")
    steps = collect_transitions(records, with_constants=True)
    steps = steps.select(np.isin(steps.seeds, list(drawn.goals)))
    goals = np.array([drawn.goals[seed] for seed in steps.seeds.tolist()])
    try:
        places, of, tolerance = _find_robot(steps, goals, drawn)
        reach = drawn.reaches.get(of) or find_reach(places, steps.episodes)
    except NotJudged:
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


def find_sources(copies: Sequence[Source], rows: Numbers, goals: Numbers) -> list[Source]:
    """Return where an observation may have the place of the robot: relative to the goal, and then by itself."""
    size = goals.shape[1]
    return [*copies, *((element, 0) for element in range(rows.shape[1] - size + 1))]


def read_place(source: Source, rows: Numbers, goals: Numbers) -> Numbers:
    """Return the place of the robot. Shapes of rows: (n, elements), of goals and the result: (n, size)."""
    element, sign = source
    part = rows[:, element : element + goals.shape[1]]
    return goals - sign * part if sign else part
