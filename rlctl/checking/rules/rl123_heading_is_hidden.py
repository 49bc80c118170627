"""RL123: heading is hidden."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.experiments.turned import TurnedRobot, TurnedStep, judges_turned
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL123",
    "heading is hidden",
    Severity.WARNING,
    meaning="""
        The check turned the robot about the vertical at the start, and let it move forwards. The observation is the
        same whatever its heading is, and the reward is another one. A policy cannot know in which direction it is
        paid for moving. An info where all episodes begin with nearly the same heading: then the policy only loses
        its way as it drifts.
    """,
    fix="""
        Observe the heading (its cosine and sine, or the way to the goal in the frame of the robot), or reward the
        velocity in the frame of the robot.
    """,
)

SPEED = 0.5  # forwards [m/s]
ANGLES = (0.0, 1.3, 2.6, 3.9, 5.2)  # [rad]
EPISODES = 2
ENOUGH, FEWEST_SAME = 4, 2  # headings after which something must be the same; pairs of all that must be
SAME = 0.02  # part of an element's size, or of 1: friction differs a little with the direction
MATTERS = 0.5  # part of what the direction of the movement changes in the reward
TINY = 1e-4  # what moving changes in a reward that does not depend on it
STARTS, VARIED = 6, 0.5  # resets, and how far their headings are apart [rad]


@judges_turned(RULE)
def _find_hidden_heading(robot: TurnedRobot) -> Iterator[RuleFinding]:
    """Yield a finding where turning changes the reward as moving does, and nothing of the observation."""
    ranges = []
    for number in range(EPISODES):
        rewards = _play_angles(robot, number)
        if rewards is None:
            return
        ranges.append(rewards)
    starts = [robot.play(number, 0.0) for number in range(STARTS)]
    severity = Severity.WARNING if _is_varied([start for start in starts if start is not None]) else Severity.INFO
    low, high = ranges[0]
    what = f"turned about the vertical, the robot observes the same and gets rewards from {low:.4g} to {high:.4g}"
    message = f"{what} for moving forwards at {SPEED:g} m/s"
    yield RuleFinding(RULE, message, {"seed": FIRST_SEED, "value": high - low, "expected": 0.0}, severity)


def _play_angles(robot: TurnedRobot, number: int) -> tuple[float, float] | None:
    """Return two rewards for moving forwards at headings with the same observation; None if it differs at nearly all
    headings, or the rewards do not."""
    steps: list[TurnedStep] = []
    changes: list[float] = []
    for angle in ANGLES:
        step, back = (robot.play(number, angle, speed) for speed in (SPEED, -SPEED))
        if step is None or back is None:
            return None
        steps.append(step)
        changes.append(abs(step.reward - back.reward))
        if len(steps) == ENOUGH and not _list_same(steps):
            return None
    change, pairs = max(changes), _list_same(steps)
    if len(pairs) < FEWEST_SAME or not change > TINY * max(1.0, *(abs(step.reward) for step in steps)):
        return None
    one, two = max(pairs, key=lambda pair: abs(pair[0].reward - pair[1].reward))
    if not abs(one.reward - two.reward) > MATTERS * change:
        return None
    return min(one.reward, two.reward), max(one.reward, two.reward)


def _list_same(steps: Sequence[TurnedStep]) -> list[tuple[TurnedStep, TurnedStep]]:
    return [(one, two) for one, two in itertools.combinations(steps, 2) if _are_same(one, two)]


def _are_same(one: TurnedStep, two: TurnedStep) -> bool:
    if one.observed.shape != two.observed.shape:
        return False
    allowed = SAME * np.maximum(1.0, np.abs(one.observed))
    return bool((np.abs(one.observed - two.observed) <= allowed).all())


def _is_varied(starts: Sequence[TurnedStep]) -> bool:
    """Say whether resets draw headings that are far apart."""
    headings = [start.heading for start in starts]
    return any(np.cos(one - other) < np.cos(VARIED) for one in headings for other in headings)
