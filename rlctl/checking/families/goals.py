"""RL619: goals that lie outside of what the robot can reach."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.families import rewards
from rlctl.checking.families.episodes import EPISODES
from rlctl.checking.families.incentives import FIRST, STARTS
from rlctl.checking.families.lateness import sample_ordinary_steps
from rlctl.checking.instance import Context, Instance
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage, Fact, Records
from rlctl.checking.regression import action_terms, fit_terms
from rlctl.checking.rules import NotApplicable, NotJudged, RuleFinding, check, experiment
from rlctl.checking.transitions import Transitions, collect_transitions, find_float_leaves
from rlctl.checking.values import Attribute, pick, read_attributes

SIZES = (2, 3)  # of a place [numbers]
MOST_CANDIDATES = 6
STEPS = 3  # in which a goal does not change
SHIFT = np.array([0.013, -0.021, 0.034])  # of a goal, to see what of the observation follows it
ROUNDING = 1e-5  # of observations to float32
FEWEST_DIRECTIONS, FEWEST_EPISODES = 6, 6  # in which the robot comes as far
SHARP = 0.005  # part of the reach: what is as far
MARGIN = 0.02  # part of the reach that the robot may get further
UNKNOWN_TOLERANCE = 0.1  # part of the reach
FEWEST_FAR, FEWEST_SUCCESSES = 2, 3
Numbers = NDArray[np.float64]


@experiment("goals", share=0.5)
def find_goals(context: Context) -> Iterator[ChildMessage]:
    """Find an attribute that is drawn at reset and stays, and the parts of the observation that follow it."""
    instance = context.instance
    if not instance.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    for name in _find_drawn(instance):
        if copies := _find_copies(instance, name):
            goals: dict[int, list[float]] = {}
            for seed in [*range(FIRST_SEED, FIRST_SEED + len(EPISODES)), *range(FIRST, FIRST + STARTS)]:
                if context.budget.why_spent():
                    break
                instance.reset(seed)
                goals[seed] = read_attributes(instance.env)[name].numbers.tolist()
            yield Fact("goals", DrawnGoal(name, copies, goals))
            return
    raise NotApplicable("the observation follows no attribute that reset draws")


def _find_drawn(instance: Instance) -> list[str]:
    """Return the attributes of the size of a place that a reset draws, and that no step changes."""
    drawn = []
    for seed in (FIRST_SEED, SECOND_SEED):
        EpisodePlayer(instance, seed, max_steps=0).reset()
        drawn.append(read_attributes(instance.env))
    names = [name for name in drawn[0].keys() & drawn[1].keys() if _is_place(drawn[0][name], drawn[1][name])]
    if not names:
        return []
    for _ in EpisodePlayer(instance, SECOND_SEED, max_steps=STEPS):
        pass
    after = read_attributes(instance.env)
    return sorted(n for n in names if n in after and np.array_equal(after[n].numbers, drawn[1][n].numbers))[
        :MOST_CANDIDATES
    ]


def _is_place(one: Attribute, two: Attribute) -> bool:
    sizes = one.numbers.size, two.numbers.size
    return sizes[0] == sizes[1] and sizes[0] in SIZES and not (one.numbers == two.numbers).any()


def _find_copies(instance: Instance, name: str) -> list[tuple[int, int]]:
    """Return where the observation has the place, or its difference to something, and with which sign."""
    plain, shifted = (_observe(instance, name, shift) for shift in (0.0, 1.0))
    if plain.shape != shifted.shape:
        return []
    change, shift = shifted - plain, SHIFT[: read_attributes(instance.env)[name].numbers.size]
    parts = [change[element : element + len(shift)] for element in range(len(change) - len(shift) + 1)]
    return [
        (i, sign) for i, part in enumerate(parts) for sign in (1, -1) if np.abs(part - sign * shift).max() < ROUNDING
    ]


def _observe(instance: Instance, name: str, shift: float) -> Numbers:
    """Return the observation of the first step if the place is shifted before it. Shape (elements,)."""
    episode = EpisodePlayer(instance, FIRST_SEED, "zero", max_steps=1)
    episode.reset()
    attribute = read_attributes(instance.env)[name]
    moved = attribute.numbers + shift * SHIFT[: attribute.numbers.size]
    attribute.assign(moved if isinstance(attribute.value, np.ndarray) else type(attribute.value)(moved.tolist()))
    observation = episode.step().observation
    parts = [np.ravel(pick(observation, instance.leaves[index].path)) for index in find_float_leaves(instance.leaves)]
    return np.concatenate([np.zeros(0), *parts])


@dataclasses.dataclass(frozen=True)
class DrawnGoal:
    """A place that each reset draws."""

    name: str  # of the attribute
    copies: Sequence[tuple[int, int]]  # Elements of the observation from which on it, or a difference to it, is; signs
    goals: Mapping[int, Sequence[float]]  # by seed


@check("RL619", *rewards.WITH_SEARCH, "goals")
def _find_goals_out_of_reach(records: Records) -> Iterator[RuleFinding]:
    rewards.require_rewarded(records)
    if "goals" in records.not_applicable:
        raise NotApplicable(records.not_applicable["goals"])
    drawn: DrawnGoal = records.require_fact("goals")
    steps = collect_transitions(records, with_constants=True)
    steps = steps.select(np.isin(steps.seeds, list(drawn.goals)))
    goals = np.array([drawn.goals[seed] for seed in steps.seeds.tolist()])
    places, tolerance = _find_robot(steps, goals, drawn)
    centre, reach = find_reach(places, steps.episodes)
    if tolerance is None:
        tolerance = UNKNOWN_TOLERANCE * reach
    all_goals = np.array(list(drawn.goals.values()))
    distances = np.linalg.norm(all_goals - centre, axis=1)
    far = distances > (1 + MARGIN) * reach + tolerance
    if far.sum() >= FEWEST_FAR:
        seed, farthest = list(drawn.goals)[int(distances.argmax())], float(distances.max())
        reached = f"no step of {len(np.unique(steps.episodes))} episodes brought the robot more than {reach:.4g}"
        message = (
            f"{int(far.sum())} of {len(far)} goals ({drawn.name}) are out of reach: up to {farthest:.4g} away from "
            f"{np.round(centre, 3).tolist()}; {reached} away from it, and it came as far in many directions"
        )
        evidence = {"seed": seed, "value": farthest, "expected": f"up to {reach + tolerance:.4g}"}
        yield RuleFinding("RL619", message, {**evidence, "element": drawn.name})


def _find_robot(steps: Transitions, goals: Numbers, drawn: DrawnGoal) -> tuple[Numbers, float | None]:
    """Return where what has to reach the goal is after each step, and at what distance that is a success; None if no
    success was seen. Shape of the places: (n, size). Raises `NotJudged` if it is not observed."""
    size, rows = goals.shape[1], steps.after
    relative = [goals - sign * rows[:, i : i + size] for i, sign in drawn.copies]
    moving = [places for places in relative if np.ptp(places[steps.episodes == steps.episodes[0]], axis=0).any()]
    for places in moving or [rows[:, i : i + size] for i in range(rows.shape[1] - size + 1)]:
        distances = np.linalg.norm(places - goals, axis=1)
        reached, rest = distances[steps.success], distances[~steps.success]
        if len(reached) >= (1 if moving else FEWEST_SUCCESSES) and reached.max() < rest.min():
            return places, float(reached.max() + rest.min()) / 2
        chosen = sample_ordinary_steps(dataclasses.replace(steps, before=distances[:, None]))
        terms = np.hstack([action_terms(chosen), chosen.before, np.square(chosen.before)])
        if np.ptp(chosen.rewards) > 0 and fit_terms(terms, chosen.rewards).is_exact:
            return places, None
    raise NotJudged("the distance between the goal and the robot is not observed")


def find_reach(places: Numbers, episodes: NDArray[np.int64]) -> tuple[Numbers, float]:
    """Return a centre and how far from it the robot comes, if it came as far in many directions: a workspace has such a
    limit, a path has not. Shapes of places: (n, size), of episodes: (n,). Raises `NotJudged` if there is none."""
    size = places.shape[1]
    directions = _spread_directions(size)
    for centre in (np.zeros(size), _fit_centre(places, directions)):
        from_centre = places - centre
        radii = np.linalg.norm(from_centre, axis=1)
        nearest = np.argmax(from_centre @ directions.T, axis=1)
        is_far = radii >= (1 - SHARP) * radii.max()
        if len(np.unique(nearest[is_far])) >= FEWEST_DIRECTIONS and len(np.unique(episodes[is_far])) >= FEWEST_EPISODES:
            return centre, float(radii.max())
    raise NotJudged("nothing limits where the robot gets")


def _spread_directions(size: int) -> Numbers:
    grid = np.array(np.meshgrid(*[(-1.0, -0.5, 0.0, 0.5, 1.0)] * size)).reshape(size, -1).T
    grid = grid[np.abs(grid).max(axis=1) == 1.0]
    return np.asarray(grid / np.linalg.norm(grid, axis=1, keepdims=True))


def _fit_centre(places: Numbers, directions: Numbers) -> Numbers:
    """Return the centre of the sphere that is nearest to the outermost places: |p|^2 = 2 p c + rest."""
    outermost = places[np.unique(np.argmax(places @ directions.T, axis=0))]
    columns = np.hstack([2 * outermost, np.ones((len(outermost), 1))])
    return np.asarray(np.linalg.lstsq(columns, np.square(outermost).sum(axis=1), rcond=1e-6)[0][:-1])
