"""RL708: command winds up."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import action_at
from rlctl.checking.experiments.sums import FEWEST_STEPS, SAME, ActionSum, FoundSums, PlayedSums, SumTrials, judges_sums
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.worlds import Array

RULE = Rule(
    "RL708",
    "command winds up",
    Severity.WARNING,
    meaning="""
        A number adds up the actions without any limit, and what is done with it has one: held at its end, the action
        changes nothing any more, and the number runs on. When the action turns round, nothing happens until the number
        is back, and that takes as long as it ran on: the longer the policy pushes against the limit, the later the
        robot answers. The check held an action, turned it round after some steps and after twice as many, and
        compared.
    """,
    fix="""
        Clip the number that is kept where it is changed, and not only what is sent to the motors: target =
        np.clip(target + step * action, low, high).
    """,
)

HELD_STEPS = 120
FIRST, SECOND = 0.3, 0.6  # parts of the steps that are played after which the action turns round
LAGS = 4  # steps by which what repeats the action may be late
RESTING = 0.02  # part of the largest change before
FEWEST_STUCK, GROWTH = 3, 0.5  # steps in which nothing happens; by how many more for each step that is held longer
SEEDS = (FIRST_SEED, FIRST_SEED + 1)


@judges_sums(RULE)
def _wind_up(found: FoundSums) -> Iterator[ChildMessage]:
    """Hold each number of the action that something adds up."""
    trials = found.trials
    copies = _find_copies(found.played)
    for one in found.sums:
        for end in (1.0, 0.0):
            if trials.instance.context.budget.is_over():
                raise NotJudged("time ran out")
            stuck = [_measure(trials, one, end, copies, seed) for seed in SEEDS]
            if all(other is not None for other in stuck) and stuck[0] is not None:
                yield _describe(trials, one, end, *stuck[0])
                return


def _find_copies(played: PlayedSums) -> set[int]:
    """Return the numbers that repeat the action, also a few steps late."""
    found: set[int] = set()
    for lag in range(LAGS):
        actions = np.column_stack([played.actions[: len(played.actions) - lag], np.ones(len(played.actions) - lag)])
        rows = np.nan_to_num(played.values[1 + lag :])
        left = rows - actions @ np.linalg.lstsq(actions, rows, rcond=None)[0]
        spread = np.ptp(rows, axis=0)
        found |= set(np.flatnonzero((np.abs(left).max(axis=0) <= SAME * spread) & (spread > 0)).tolist())
    return found


def _measure(
    trials: SumTrials, one: ActionSum, end: float, copies: set[int], seed: int
) -> tuple[int, int, int, int, float] | None:
    """Return after how many steps the action turned round and for how many nothing happened, twice, and the number
    that had added it up; None where it does not wind up."""
    space = trials.instance.env.action_space
    size = sum(int(np.prod(leaf.shape)) for leaf in trials.instance.action_leaves)
    held_action, turned_action = (
        action_at(space, np.where(np.arange(size) == one.element, part, 0.5)) for part in (end, 1 - end)
    )
    held = trials.play(seed, [held_action] * HELD_STEPS)
    steps = len(held.actions)
    runs = np.diff(held.values[:, one.column])
    wanted = one.factor * held.actions[:, one.element]
    if steps < FEWEST_STEPS or np.abs(runs - wanted).max() > SAME * np.abs(wanted).max():
        return None  # it has a limit
    first, second = int(FIRST * steps), int(SECOND * steps)
    rows = held.commands if trials.has_engine else np.delete(held.values, sorted(copies), axis=1)
    followers = _find_followers(rows, first, second, exact=trials.has_engine)
    if not followers.size:
        return None
    stuck = []
    for turn in (first, second):
        turned = trials.play(seed, [held_action] * turn + [turned_action] * (steps - turn))
        others = turned.commands if trials.has_engine else np.delete(turned.values, sorted(copies), axis=1)
        stuck.append(_count_stuck(rows, others, followers, turn))
    # What nothing answers to the end of the episode counts as answered there.
    if stuck[1] < FEWEST_STUCK or stuck[1] - stuck[0] < max(2, GROWTH * (second - first)):
        return None
    return first, stuck[0], second, stuck[1], float(held.values[second, one.column])


def _find_followers(rows: Array, first: int, second: int, *, exact: bool) -> NDArray[np.intp]:
    """Return the columns that moved at first, and then rest while the action is still held."""
    changes = np.abs(np.diff(np.nan_to_num(rows[1:]), axis=0))
    early, late = changes[: first - 1], changes[first - 1 : second - 1]
    if not len(early) or not len(late):
        return np.zeros(0, np.intp)
    most = 0.0 if exact else RESTING
    return np.flatnonzero((early.max(axis=0) > 0) & (late.max(axis=0) <= most * early.max(axis=0)))


def _count_stuck(held: Array, turned: Array, followers: NDArray[np.intp], turn: int) -> int:
    """Return after how many steps with the opposite action something differs from holding it on."""
    length = min(len(held), len(turned))
    differs = (held[turn + 1 : length, followers] != turned[turn + 1 : length, followers]).any(axis=1)
    return int(differs.argmax()) if differs.any() else len(differs)


def _describe(
    trials: SumTrials, one: ActionSum, end: float, first: int, early: int, second: int, late: int, value: float
) -> RuleFinding:
    name, which = trials.name(one.column), "highest" if end else "lowest"
    message = f"{name} adds up action[{one.element}] without a limit: held at its {which} for {second} steps, it is"
    message += f" {value:.4g}, and the opposite action then changes nothing for {late} steps; for {early} after {first}"
    return RuleFinding(RULE, message, {"element": name, "value": value, "seed": FIRST_SEED, "step": second})
