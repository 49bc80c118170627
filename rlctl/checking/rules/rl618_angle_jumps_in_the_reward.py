"""RL618: angle jumps in the reward."""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import rewards
from rlctl.checking.drawn_goals import Source
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.goals import judges_goals
from rlctl.checking.experiments.turned import TurnedRobot, judges_turned
from rlctl.checking.goal_episodes import PLACED_STEPS, GoalEpisode, GoalTrials
from rlctl.checking.records import FIRST_SEED, Records
from rlctl.checking.rule import NotApplicable, Rule, RuleFinding, Severity
from rlctl.checking.transitions import Transitions, collect_transitions, find_unit_pairs
from rlctl.checking.unwrapped_angles import UnwrappedAngles

RULE = Rule(
    "RL618",
    "angle jumps in the reward",
    Severity.WARNING,
    meaning="""
        The reward jumps in the steps in which an observed angle passes from pi to -pi, and hardly ever else.
        The robot itself moves on smoothly there: the reward uses a difference of two angles that is not
        wrapped, so an error of 0.1 rad counts as one of 6.2, and turning the short way is punished. Robots with a
        free base are also turned by the check, all around the vertical, and goals are moved around the robot. In the
        source, a difference of two directions that may be more than half a turn is made a whole turn less, and another
        reward is paid.
    """,
    fix="Wrap the difference, (a - b + pi) % (2 * pi) - pi, or use 1 - cos(a - b).",
)

NEAR_TURN = 1.0  # an angle that passes pi changes by 2 pi +- NEAR_TURN [rad]
SMALL_TURN = 1.5  # and by less than this in all other steps [rad]
NEIGHBOURS = 3  # steps before and after a jump that it is compared with
JUMP = 3.0  # times the largest change of its neighbours
FEWEST_JUMPS, FEWEST_SEEDS = 4, 3
MOST_PASSES = 0.4  # part of the passes with a jump: those near a difference of 0 have none
LEAST_ROOM, SPREAD = 0.2, 2.5  # of pi - |e|: least [rad], and how much the largest of them exceed the smallest
LITTLE = 0.5  # [rad] by which e changes in a step
SAME_FACTOR, MOST_FIT = 0.15, 0.7  # how equal factors are, and what part of all jumps they explain
RARE = 0.05  # the same of all other steps, relative to that of the passes
_SHIFTS = [shift for shift in range(-NEIGHBOURS, NEIGHBOURS + 1) if shift]


TURNS, HALVINGS = 12, 10  # headings all around, and how often the interval of the largest change is halved
TURNED_SEEDS, MOST_SEEDS, MOST_STEADY = 2, 4, 1
"""Starts that have to show it, that are tried, and that may not: where heading 0 is wanted, nothing jumps."""
DIRECTIONS, CLEARLY = 24, 3.0  # of a goal, and how much more the reward has to change at pi than between any others
DISTANCE = 0.5  # part of the goals' range, at which a goal is moved around the robot
LARGE_JUMP = 0.5  # part of that change which is left then: of a smooth function it is a thousandth
NEAR_PI = 0.01  # of where it is [rad]

MOST_DIRECTIONS, ALL_AROUND = 24, 8  # pairs that are tried; eighths of a turn in which a direction has to be


@judges_records(RULE, *rewards.WITH_SEARCH, "turned", "goals")
def _find_jumps_of_angles(records: Records) -> Iterator[RuleFinding]:
    rewards.require_rewarded(records)
    steps = collect_transitions(records)
    passes, pairs = _find_passes(steps), _find_directions(steps)
    if not passes and not pairs:
        if records.finished.get("turned") is not None and "turned" not in records.not_applicable:
            return
        raise NotApplicable("no angle is observed that passes pi")
    jumps = _find_jumps(steps)
    size, where = _judge_passes(steps, passes, jumps) or _judge_errors(steps, pairs, jumps) or (0.0, "")
    if where:
        yield RuleFinding(RULE, f"the reward jumps by {size:.3g} {where}", {"value": size, "expected": "no jump"})


@judges_expressions(RULE, decides=False)
def _turn_differences(notes: NotedEpisodes) -> Iterator[RuleFinding]:
    for one, largest in notes.share(UnwrappedAngles).find_paid():
        message = (
            f"{one.text} is a difference of two directions, here up to {largest:.3g} rad; a whole turn less, which"
        )
        message += " is the same, pays otherwise"
        yield RuleFinding(RULE, message, {"element": one.text, "value": largest}, where=one.where)
        return


@judges_turned(RULE, decides=False)
def _turn_around(robot: TurnedRobot) -> Iterator[RuleFinding]:
    """Yield a finding where the reward jumps at the heading pi, from whatever start."""
    if (found := _find_jump_of_starts(functools.partial(_find_turned_jump, robot))) is not None:
        seed, jump = found
        message = f"the reward jumps by {jump:.3g} where the heading of the robot passes from pi to -pi"
        yield RuleFinding(RULE, message, {"seed": seed, "value": jump, "expected": "no jump"})


def _find_jump_of_starts(find: Callable[[int], float | None]) -> tuple[int, float] | None:
    """Return the seed of a start and the first jump that `find` returns for its number; None if too few have one."""
    found: list[tuple[int, float]] = []
    for number in range(MOST_SEEDS):
        if (jump := find(number)) is not None:
            found.append((FIRST_SEED + number, jump))
        if len(found) == TURNED_SEEDS:
            return found[0]
        if number + 1 - len(found) > MOST_STEADY:
            return None
    return None


def _find_turned_jump(robot: TurnedRobot, number: int) -> float | None:
    start = robot.play(number, 0.0)
    return None if start is None else _find_jump(functools.partial(_pay_turned, robot, number, start.heading))


def _pay_turned(robot: TurnedRobot, number: int, start: float, heading: float) -> float:
    step = robot.play(number, heading - start)
    return np.nan if step is None else step.reward


@judges_goals(RULE, decides=False, place=2)
def _move_goal_around(trials: GoalTrials) -> Iterator[RuleFinding]:
    """Yield a finding where the reward jumps with the goal in the direction pi from the robot, whatever its heading."""
    sources = [trials.at_goal.source, *trials.drawn.turned, *trials.drawn.copies]
    source = next((one for one in sources if one is not None), None)
    if source is None or trials.drawn.place.size < 2 or trials.drawn.place.is_pose:
        return
    found = _find_jump_of_starts(functools.partial(_find_goal_jump, trials, source))
    if found is None:
        return
    seed, jump = found
    message = f"the reward jumps by {jump:.3g} where the direction of {trials.drawn.name} from the robot passes from"
    evidence = {"element": trials.drawn.name, "seed": seed, "value": jump, "expected": "no jump"}
    yield RuleFinding(RULE, f"{message} pi to -pi", evidence)


def _pay_goal(trials: GoalTrials, source: Source, seed: int, direction: float) -> float:
    """Return what a step pays with the goal in a direction from the robot [rad]."""
    episode = GoalEpisode(trials, seed, "repeated", PLACED_STEPS)
    away = np.zeros(trials.drawn.place.size)
    away[:2] = DISTANCE * trials.range[:2].max() * np.array([np.cos(direction), np.sin(direction)])
    goal = episode.read(source) + away
    steps = episode.play([goal, goal])  # the first may pay the way of the goal as progress
    return steps[-1].reward if len(steps) == 2 else np.nan


def _find_goal_jump(trials: GoalTrials, source: Source, number: int) -> float | None:
    """Return how much the reward jumps with the goal in the direction pi; None if it changes as much elsewhere, and
    if no time is left."""
    seed = FIRST_SEED + number
    if trials.instance.context.budget.is_over() or GoalEpisode(trials, seed, "repeated", PLACED_STEPS).has_ended:
        return None
    width = 2 * np.pi / DIRECTIONS
    directions = np.pi + width * (np.arange(DIRECTIONS) + 0.5)
    paid = np.array([_pay_goal(trials, source, seed, float(direction)) for direction in directions])
    jump = float(abs(paid[0] - paid[-1]))
    return jump if jump > CLEARLY * np.abs(np.diff(paid)).max() else None


def _find_jump(pay: Callable[[float], float]) -> float | None:
    """Return how much the reward jumps at the angle pi; None if it is steady there, or jumps more elsewhere."""
    low, high = np.pi - np.pi / TURNS, np.pi + np.pi / TURNS
    around = np.array([pay(angle) for angle in np.linspace(high, low + 2 * np.pi, TURNS)])
    first, last = float(around[-1]), float(around[0])  # at `low` and at `high`
    whole = abs(last - first)
    if not whole > np.nanmax(np.abs(np.diff(around)), initial=0.0):
        return None
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        reward = pay(middle)
        if abs(reward - first) > abs(last - reward):
            high, last = middle, reward
        else:
            low, first = middle, reward
    jump = abs(last - first)
    is_at_pi = abs(low - np.pi) < NEAR_PI
    return jump if is_at_pi and jump > LARGE_JUMP * whole else None


@dataclasses.dataclass(frozen=True, eq=False)
class _Jumps:
    """Where the reward changes much more than in the steps around."""

    is_jump: NDArray[np.bool_]  # Shape (n,)
    is_judged: NDArray[np.bool_]  # Whether the steps around are known. Shape (n,)
    sizes: NDArray[np.float64]  # of the changes. Shape (n,)

    def are_many(self, steps: Transitions, rows: NDArray[np.bool_], fewest: int = FEWEST_JUMPS) -> bool:
        return rows.sum() >= fewest and len(np.unique(steps.seeds[rows])) >= FEWEST_SEEDS


def _judge_passes(
    steps: Transitions, passes: Mapping[str, NDArray[np.bool_]], jumps: _Jumps
) -> tuple[float, str] | None:
    """Return how much the reward jumps where an angle passes pi, and where; None if it does not."""
    for name, is_pass in passes.items():
        judged, elsewhere = is_pass & jumps.is_judged, ~is_pass & jumps.is_judged
        jumping = judged & jumps.is_jump
        others = float((elsewhere & jumps.is_jump).sum() / max(1, elsewhere.sum()))
        share = float(jumping.sum() / max(1, judged.sum()))
        if jumps.are_many(steps, jumping) and share >= MOST_PASSES and others <= RARE * share:
            size = float(np.median(jumps.sizes[jumping]))
            where = f"in {int(jumping.sum())} of {int(judged.sum())} steps in which {name} passes pi"
            return size, f"(median) {where}, and in {others:.1%} of all other steps"
    return None


def _judge_errors(steps: Transitions, pairs: Sequence[tuple[int, int]], jumps: _Jumps) -> tuple[float, str] | None:
    """Return how the reward jumps as an error e that becomes e - 2 pi would make it, |e| and e^2 alike: by a constant
    times pi - |e|, where its cosine and sine are observed, or a vector in its direction. None if it does not. With
    |e| before and after a step, the change of |e| is 2 pi less both: so pi less their mean is exact."""
    known = find_unit_pairs(steps.before)
    for cosine, sine in [pair for i, j in pairs for pair in ((i, j), (j, i))]:
        # One of many pairs that may be no direction fits a few jumps by chance.
        fewest = FEWEST_JUMPS if {(cosine, sine), (sine, cosine)} & {*known} else 2 * FEWEST_JUMPS
        angles = [_angle(rows, cosine, sine) for rows in (steps.before, steps.after)]
        room = np.pi - np.mean(np.abs(angles), axis=0)
        moved = np.abs((angles[1] - angles[0] + np.pi) % (2 * np.pi) - np.pi)
        rows = jumps.is_jump & (room > LEAST_ROOM) & (moved < LITTLE)
        if not jumps.are_many(steps, rows, fewest):
            continue
        factors = jumps.sizes[rows] / room[rows]
        fits = np.abs(factors / np.median(factors) - 1) < SAME_FACTOR
        low, high = np.quantile(room[rows][fits], (0.1, 0.9)) if fits.any() else (1.0, 1.0)
        rows[rows] = fits
        if jumps.are_many(steps, rows, fewest) and fits.mean() >= MOST_FIT and high > SPREAD * low:
            name = f"({steps.names[cosine]}, {steps.names[sine]})"
            factor = float(np.median(factors))
            where = f"in {int(rows.sum())} steps in which the angle e of {name} changes little"
            return factor, f"times pi - |e| {where}, as if e were e + 2 pi there"
    return None


def _find_directions(steps: Transitions) -> list[tuple[int, int]]:
    """Return the cosines and sines of angles, and pairs of consecutive elements that point in all directions, such as
    the way to a goal in the frame of the robot."""
    pairs = find_unit_pairs(steps.before)
    for column in range(min(len(steps.names) - 1, MOST_DIRECTIONS)):
        angles = _angle(steps.before, column, column + 1)
        if (column, column + 1) not in pairs and len(np.unique(np.round(angles / (np.pi / 4)))) >= ALL_AROUND:
            pairs.append((column, column + 1))
    return pairs


def _find_passes(steps: Transitions) -> dict[str, NDArray[np.bool_]]:
    """Return for each observed angle in which steps it passes from pi to -pi or back, by name. Shape (n,) each."""
    angles = {name: (steps.before[:, i], steps.after[:, i]) for i, name in enumerate(steps.names)}
    for i, j in find_unit_pairs(steps.before):
        names = f"({steps.names[i]}, {steps.names[j]})"
        angles[f"the angle of {names}"] = (_angle(steps.before, i, j), _angle(steps.after, i, j))
        angles[f"the angle of {names} from its sine"] = (_angle(steps.before, j, i), _angle(steps.after, j, i))
    passes = {}
    for name, (before, after) in angles.items():
        change = np.abs(after - before)
        is_pass = np.abs(change - 2 * np.pi) < NEAR_TURN
        if is_pass.sum() >= FEWEST_JUMPS and (is_pass | (change < SMALL_TURN)).all():
            passes[name] = is_pass
    return passes


def _angle(rows: NDArray[np.float64], cosine: int, sine: int) -> NDArray[np.float64]:
    return np.arctan2(rows[:, sine], rows[:, cosine])


def _find_jumps(steps: Transitions) -> _Jumps:
    changes = np.abs(np.diff(steps.rewards, prepend=np.nan))
    is_ordinary = ~(steps.success | steps.terminated | steps.is_last)
    is_ordinary &= np.r_[False, np.diff(steps.episodes) == 0]
    changes[~is_ordinary] = np.nan
    padded = np.pad(changes, NEIGHBOURS, constant_values=np.nan)
    around = [padded[NEIGHBOURS + shift : NEIGHBOURS + shift + len(changes)] for shift in _SHIFTS]
    neighbours = np.max(around, axis=0)  # NaN where one of them is
    is_judged = np.isfinite(neighbours) & np.isfinite(changes)
    with np.errstate(invalid="ignore"):
        is_jump = is_judged & (changes > JUMP * neighbours) & (changes > 0)
    return _Jumps(is_jump, is_judged, changes)
