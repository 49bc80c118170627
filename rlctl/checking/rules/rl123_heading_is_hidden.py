"""RL123: heading is hidden."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.experiments.turned import TurnedRobot, TurnedStep, judges_turned
from rlctl.checking.heading_waves import HEADINGS, SAME, observe_headings
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.transitions import name_floats

RULE = Rule(
    "RL123",
    "heading is hidden",
    Severity.WARNING,
    meaning="""
        The check turned the robot about the vertical at the start, and let it move forwards. The observation is
        the same whatever its heading is, and the reward is another one: a policy cannot know in which direction
        it is paid for moving. Or all of the observation is the same but a velocity in the axes of the world, or
        one axis of it, which says nothing to a robot that moves by joints, or is pushed in its own frame, and does
        not know its heading. An info where all episodes begin with nearly the same heading: then the policy only
        loses its way as it drifts.
    """,
    fix="""
        Observe the heading (its cosine and sine, or the way to the goal in the frame of the robot), or reward and
        observe the velocity in the frame of the robot.
    """,
)

WAYS = ((0.5, 0.1), (0.15, 0.1), (0.5, 0.0))
"""Speeds forwards [m/s], and how far the robot is lifted [m]: in the air no friction changes with the direction. A
reward that falls steeply with an error is nothing at the wrong speed."""
EPISODES, CONFIRMED = 5, 2  # that are played at most, and that have to show it: some commands are nearly 0
ENOUGH, FEWEST_SAME = 4, 2  # headings after which something must be the same; pairs of all that must be
MATTERS, NOTHING = 0.25, 0.01  # parts of what the direction of the movement changes in the reward: matters; does not
MATTERS_STANDING = 0.5
TINY = 1e-4  # what moving changes in a reward that does not depend on it
STARTS, VARIED = 6, 0.5  # resets, and how far their headings are apart [rad]
Pair = tuple[TurnedStep, TurnedStep]


@judges_turned(RULE)
def _find_hidden_heading(robot: TurnedRobot) -> Iterator[RuleFinding]:
    """Yield a finding where turning changes the reward as moving does, and nothing of the observation."""
    is_sound = False
    shown: list[tuple[Pair, float]] = []
    for speed, lift in WAYS:
        if (is_sound or shown) and not lift:
            break
        found: list[Pair] = []
        for number in range(EPISODES):
            played = _play_angles(robot, number, speed, lift)
            if played is None:
                return
            pair, part = played
            if part < NOTHING:
                is_sound = True
                break
            if part > (MATTERS if lift else MATTERS_STANDING):
                found.append(pair)
            if len(found) == CONFIRMED:
                shown += [(pair, speed) for pair in found]
                break
    if shown:
        yield _hidden(robot, *max(shown, key=lambda one: _compare(one[0])))


@judges_turned(RULE, place=1)
def _find_world_velocity(robot: TurnedRobot) -> Iterator[RuleFinding]:
    """Yield a finding where velocities in the axes of the world are all of the observation that turns with the
    robot."""
    if not robot.pushes_itself:
        return
    found: list[set[int]] = []
    for number in range(CONFIRMED):
        columns = _list_world_velocities(robot, number)
        if not columns:
            return
        found.append(columns)
    columns = set.intersection(*found)
    if not columns:
        return
    names = name_floats(robot.instance.leaves)
    listed = list_names([names[column] for column in sorted(columns)])
    what = "are a velocity" if len(columns) > 1 else "is a velocity"
    message = f"{listed} {what} in the axes of the world, and nothing of the observation shows the heading of"
    message += " the robot: turned about the vertical, and moving in the same way, it observes the same otherwise"
    evidence = {"element": names[min(columns)], "seed": FIRST_SEED}
    yield RuleFinding(RULE, message, evidence, _judge_starts(robot))


def _list_world_velocities(robot: TurnedRobot, number: int) -> set[int]:
    """Return the elements that are a velocity in the axes of the world; none where others show the heading."""
    waves = observe_headings(robot, number)
    if waves is None:
        return set()
    velocities = waves.list_velocities(times=1)
    is_direction_shown = len(velocities) > 1 and waves.has_own_velocity()
    return velocities if waves.list_changing() <= velocities and not is_direction_shown else set()


def _hidden(robot: TurnedRobot, pair: tuple[TurnedStep, TurnedStep], speed: float) -> RuleFinding:
    low, high = sorted(step.reward for step in pair)
    what = f"turned about the vertical, the robot observes the same and gets rewards from {low:.4g} to {high:.4g}"
    message = f"{what} for moving forwards at {speed:g} m/s"
    one, two = (step.terms for step in pair)
    if shared := one.keys() & two.keys():
        term = max(shared, key=lambda name: abs(one[name] - two[name]))
        message += f"; term {term!r} is from {min(one[term], two[term]):.4g} to {max(one[term], two[term]):.4g}"
    return RuleFinding(RULE, message, {"seed": FIRST_SEED, "value": high - low, "expected": 0.0}, _judge_starts(robot))


def _play_angles(robot: TurnedRobot, number: int, speed: float, lift: float) -> tuple[Pair, float] | None:
    """Return two steps of moving forwards at headings with the same observation, and how far their rewards differ,
    as part of what moving backwards changes; None if the observation differs at nearly all headings."""
    back = robot.play(number, HEADINGS[0], -speed, lift)
    if back is None:
        return None
    steps: list[TurnedStep] = []
    for angle in HEADINGS:
        step = robot.play(number, angle, speed, lift)
        if step is None:
            return None
        steps.append(step)
        if len(steps) == ENOUGH and not _list_same(steps):
            return None
    pairs = _list_same(steps)
    if len(pairs) < FEWEST_SAME:
        return None
    one, two = max(pairs, key=_compare)
    difference = _compare((one, two))
    change = max(difference, abs(steps[0].reward - back.reward))
    least = TINY * max(1.0, *(abs(step.reward) for step in steps))
    return (one, two), difference / change if change > least else 0.5 * MATTERS


def _compare(pair: Pair) -> float:
    return abs(pair[0].reward - pair[1].reward)


def _list_same(steps: Sequence[TurnedStep]) -> list[tuple[TurnedStep, TurnedStep]]:
    return [(one, two) for one, two in itertools.combinations(steps, 2) if _are_same(one, two)]


def _are_same(one: TurnedStep, two: TurnedStep) -> bool:
    if one.observed.shape != two.observed.shape:
        return False
    allowed = SAME * np.maximum(1.0, np.abs(one.observed))
    return bool((np.abs(one.observed - two.observed) <= allowed).all())


def _judge_starts(robot: TurnedRobot) -> Severity:
    starts = [robot.play(number, 0.0) for number in range(STARTS)]
    return Severity.WARNING if _is_varied([start for start in starts if start is not None]) else Severity.INFO


def _is_varied(starts: Sequence[TurnedStep]) -> bool:
    """Say whether resets draw headings that are far apart."""
    headings = [start.heading for start in starts]
    return any(np.cos(one - other) < np.cos(VARIED) for one in headings for other in headings)
