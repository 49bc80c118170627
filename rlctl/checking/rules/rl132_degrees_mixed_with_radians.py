"""RL132: degrees mixed with radians."""

from collections.abc import Iterator

from rlctl.checking.angle_mistakes import AngleMistakes, find_first
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL132",
    "degrees mixed with radians",
    Severity.WARNING,
    meaning="""
        The source adds degrees to radians, subtracts or compares them, divides one by the other, converts an angle
        twice or in the wrong direction, converts a gain per radian as if it were an angle, or keeps one in what is
        called the other. The check follows each expression to where it comes from: functions that convert, engines
        and arctan2, whose angles are in radians, names such as MAX_TILT_DEG, and comments such as # [deg] or # rad. Or
        an angle whose sine is taken, or which is wrapped, is compared with a number of more than a whole turn, as 12.
    """,
    fix="Convert once, where a number in degrees is given: np.deg2rad(MAX_TILT_DEG); compute in radians.",
)


@judges_expressions(RULE)
def _find_mixed_units(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    yield from find_first(RULE, noted.share(AngleMistakes).of_mixtures)
