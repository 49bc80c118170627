"""RL623: moving to and fro pays."""

from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.drawn_goals import Numbers
from rlctl.checking.experiments.goals import judges_goals
from rlctl.checking.goal_episodes import ROUNDING, GoalEpisode, GoalStep, GoalTrials
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL623",
    "moving to and fro pays",
    Severity.WARNING,
    meaning="""
        Progress towards the goal is paid, and the way back is not taken back. The check moved the goal to and fro
        while the robot did nothing: each time the reward was larger than with either goal alone, in proportion
        to the way. A policy that shakes earns more than one that arrives.
    """,
    fix="""
        Pay the difference of the distances, previous - distance, without a lower limit, or only what is nearer
        than the nearest so far.
    """,
)

LOOPS, WARM_UP = 3, 2
MOST_GOALS = 3  # of other episodes, that are tried where the first is reached at once
PART = 0.04  # of the goals' range: how far the goal is moved
DIRECTIONS = np.array([[1.0, 0.62, 0.35], [-0.47, 1.0, -0.71]])  # no axis, in case the robot is beside the goal
LEAST = 1e-6  # differences of rewards that count, of their size
SMALL = 0.05  # part of what a way of the goal pays, that is no gain
SAME = 0.4  # part by which the gain of loops may differ, and that of half the way from half the gain


@judges_goals(RULE)
def _move_to_and_fro(trials: GoalTrials) -> Iterator[ChildMessage]:
    """Play the same episode with the goal at one place, at another, and to and fro."""
    for near in trials.goals[:MOST_GOALS]:
        one = _play(trials, [near] * (WARM_UP + 2 * LOOPS))
        if _is_complete(one):
            break
    else:
        yield Skipped(RULE.id, "episodes are too short, or begin with a success", applies=False)
        return
    for direction in DIRECTIONS[:, : near.size]:
        way = PART * trials.range * direction
        gains = _measure_gains(trials, one, near, near + way)
        if gains is None or gains.min() <= 0:
            continue
        half = _measure_gains(trials, one, near, near + way / 2)
        if half is None or not _are_in_proportion(gains, half):
            continue
        if _play(trials, [near] * len(one)) != one:
            yield Skipped(RULE.id, "equal seeds and actions give unequal episodes (RL3)")
            return
        if _moves_the_robot(trials, near, near + way):
            continue
        gain, length, name = float(gains.mean()), float(np.linalg.norm(way)), trials.drawn.name
        message = f"the reward is {gain:.3g} more each time {name} moves by {length:.3g} and back; it should be 0"
        yield RuleFinding(RULE, message, {"element": name, "seed": FIRST_SEED, "value": gain, "expected": 0.0})
        return


def _moves_the_robot(trials: GoalTrials, near: Numbers, far: Numbers) -> bool:
    """Say whether the robot ends elsewhere: what is drawn is no goal then, but a force, or a current."""
    alone, moved = (GoalEpisode(trials, FIRST_SEED) for _ in range(2))
    alone.play([near] * (WARM_UP + 2 * LOOPS))
    seen = alone.observed
    moved.play([near] * WARM_UP + [far, near] * LOOPS)
    return not np.allclose(moved.observed, seen, rtol=0.0, atol=ROUNDING)


def _play(trials: GoalTrials, goals: Sequence[Numbers]) -> list[GoalStep]:
    return GoalEpisode(trials, FIRST_SEED).play(goals)


def _is_complete(steps: Sequence[GoalStep]) -> bool:
    return len(steps) == WARM_UP + 2 * LOOPS and not any(step.succeeds for step in steps)


def _measure_gains(trials: GoalTrials, one: Sequence[GoalStep], near: Numbers, far: Numbers) -> Numbers | None:
    """Return what each loop earns that its goals alone do not: 0 for every reward that follows from where everything
    is, and for every difference of such a function. Shape (LOOPS,)."""
    other = _play(trials, [far] * len(one))
    both = _play(trials, [near] * WARM_UP + [far, near] * LOOPS)
    if not _is_complete(other) or not _is_complete(both):
        return None
    rewards = [np.array([step.reward for step in steps[WARM_UP:]]) for steps in (one, other, both)]
    alone = np.where(np.arange(2 * LOOPS) % 2 == 0, rewards[1], rewards[0])
    gains = (rewards[2] - alone).reshape(LOOPS, 2).sum(axis=1)
    least = LEAST * max(1.0, float(np.abs(rewards).max()))
    # A robot that moves meanwhile is paid by where it is, too: by a small part of the way of the goal.
    least = max(least, SMALL * float(np.abs(rewards[2] - alone).max()))
    return np.where(np.abs(gains) > least, gains, 0.0)


def _are_in_proportion(gains: Numbers, half: Numbers) -> bool:
    """Say whether all loops earn about the same, and half the way about half of it."""
    is_steady = np.ptp(gains) <= SAME * gains.max()
    return bool(is_steady and np.abs(2 * half.mean() / gains.mean() - 1) <= SAME)
