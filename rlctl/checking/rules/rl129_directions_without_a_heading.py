"""RL129: directions without a heading."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.rotated import RotatedRobot, judges_rotated
from rlctl.checking.observed_frames import find_world_vectors
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.transitions import name_floats
from rlctl.checking.turnings import Turning

RULE = Rule(
    "RL129",
    "directions without a heading",
    Severity.WARNING,
    meaning="""
        The check turned a robot about the vertical together with all of its world: attributes that are vectors and
        angles, or, of a robot on a vertical hinge, the hinge and what is free. What is observed in the frame of the
        robot stays the same then. Some elements turn, so they are in the axes of the world, and nothing of the
        observation shows the heading: a policy cannot know in which direction of the robot they point. Or all of the
        observation stays the same, and the reward is another one. Or elements turn twice as far: they are turned in the
        wrong direction. Or the source puts a vector of the world into the observation next to one that it turns into
        the frame of the robot, or one that it turns into it elsewhere. An info where all episodes begin with nearly the
        same heading: then the policy only loses its way as it turns.
    """,
    fix="""
        Turn the vectors into the frame of the robot, x' = cos(yaw) x + sin(yaw) y and y' = cos(yaw) y - sin(yaw) x, or
        observe the cosine and the sine of its heading.
    """,
)

MOSTLY = 0.6  # part of these that have to show an element
CONFIRMED = 3  # episodes with other seeds, at least
TURNED = ("RL124", "RL125")  # A vector in no frame of the robot hides the heading, too
VARIED = 0.5  # how far headings at the start are apart [rad]
SAME = 0.02  # part of the size of a cosine by which its size may change
TURN_ERROR = 0.1  # part of the length of a vector
SAME_DIRECTION = 0.9  # length of the mean of unit vectors
MATTERS = 0.25  # part of what rewards differ by in episodes that are not turned
TINY = 1e-4  # of rewards


@judges_expressions(RULE, decides=False)
def _judge_source(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    yield from itertools.islice(find_world_vectors(RULE, noted.turned, noted.observed), 1)


@judges_rotated(RULE)
def _find_world_vectors(robot: RotatedRobot) -> Iterator[RuleFinding]:
    """Yield a finding where elements turn with the world, or the reward does, and nothing shows the heading."""
    turnings = [turning for turning in robot.turnings if turning.is_explained]
    if len(turnings) < CONFIRMED:
        return
    if all(turning.doubles.any() for turning in turnings):
        yield from _describe_doubles(robot, turnings)
        return
    if any(turning.shows.any() | turning.doubles.any() for turning in turnings) or _shows_heading(turnings):
        return
    names = name_floats(robot.instance.leaves)
    turns = np.any([turning.turns for turning in turnings], axis=0)
    is_clear = np.mean([turning.turns & turning.is_clear for turning in turnings], axis=0) > MOSTLY
    columns = np.flatnonzero(is_clear).tolist()
    severity = Severity.WARNING if _are_varied(turnings) else Severity.INFO
    if columns:
        listed = list_names([names[column] for column in columns])
        message = (
            f"{listed} are in the axes of the world, and nothing of the observation shows the heading of the robot,"
        )
        message += f" {robot.heading_name}: with its world turned about the vertical it observes the same otherwise"
        yield RuleFinding(RULE, message, {"element": names[columns[0]], "seed": FIRST_SEED}, severity, same=TURNED)
    if turns.any():
        return
    rewards = [np.array([episode.rewards for episode in turning.common]) for turning in turnings]
    spread = float(np.ptp(np.concatenate([each[0] for each in rewards])))
    least = max(TINY, MATTERS * spread)
    if np.mean([np.ptp(each, axis=0).max() > least for each in rewards]) > MOSTLY:
        low, high = rewards[0][:, -1].min(), rewards[0][:, -1].max()
        message = (
            f"with its world turned about the vertical, the robot observes the same and gets rewards from {low:.4g}"
        )
        message += f" to {high:.4g}: nothing of the observation shows its heading {robot.heading_name}"
        evidence = {"seed": FIRST_SEED, "value": high - low, "expected": 0.0}
        yield RuleFinding(RULE, message, evidence, severity, same=TURNED)


def _describe_doubles(robot: RotatedRobot, turnings: Sequence[Turning]) -> Iterator[RuleFinding]:
    names = name_floats(robot.instance.leaves)
    columns = np.flatnonzero(np.all([turning.doubles for turning in turnings], axis=0)).tolist()
    if columns:
        turn, are = ("turn", "they are") if len(columns) > 1 else ("turns", "it is")
        message = f"{list_names([names[column] for column in columns])} {turn} twice as far as the world does: {are}"
        message += f" turned by the heading of the robot, {robot.heading_name}, in the wrong direction"
        yield RuleFinding(RULE, message, {"element": names[columns[0]], "seed": FIRST_SEED}, same=TURNED)


def _are_varied(turnings: Sequence[Turning]) -> bool:
    """Say whether resets draw headings that are far apart."""
    headings = [turning.episodes[0].headings[0] for turning in turnings]
    return any(np.cos(one - other) < np.cos(VARIED) for one in headings for other in headings)


def _shows_heading(turnings: Sequence[Turning]) -> bool:
    """Say whether elements in the axes of the world show the heading: a cosine, or a vector that points in the same
    direction seen from the robot, such as its velocity; or one that is observed in the frame of the robot too."""
    turns = np.any([turning.turns for turning in turnings], axis=0)
    amplitudes = np.concatenate([turning.amplitudes for turning in turnings])
    phases = np.concatenate([turning.phases + turning.common[0].headings[:, None] for turning in turnings])
    observed = np.concatenate([turning.common[0].observed for turning in turnings])
    columns = np.flatnonzero(turns).tolist()
    if any(np.std(amplitudes[:, column]) < SAME * np.mean(amplitudes[:, column]) for column in columns):
        return True
    for one, two in itertools.combinations(columns, 2):
        lengths = amplitudes[:, one]
        is_pair = np.abs(np.cos(phases[:, one] - phases[:, two])).max() < TURN_ERROR
        if not is_pair or np.abs(lengths - amplitudes[:, two]).max() > TURN_ERROR * lengths.max():
            continue
        direction = (lengths * np.exp(1j * phases[:, one])).sum() / lengths.sum()
        if abs(direction) > SAME_DIRECTION or _has_length(observed[:, ~turns], lengths):
            return True
    return False


def _has_length(observed: NDArray[np.float64], lengths: NDArray[np.float64]) -> bool:
    """Say whether two elements that follow each other are as long as given, times a factor."""
    pairs = np.hypot(observed[:, :-1], observed[:, 1:])
    factors = (lengths @ pairs) / np.maximum(np.square(pairs).sum(axis=0), 1e-12)
    left = np.abs(lengths[:, None] - factors * pairs).max(axis=0, initial=0.0)
    return bool((left < TURN_ERROR * lengths.max()).any())
