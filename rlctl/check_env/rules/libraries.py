"""What the libraries' own checkers say and no other rule owns, and what of it is left out."""

from __future__ import annotations

import re
from collections.abc import Iterator

from rlctl.check_env.evidence import GYMNASIUM, SB3, Complaint, Evidence
from rlctl.check_env.finding import NotJudged, Seen, Severity, rule

NOISE = tuple(
    re.compile(pattern)
    for pattern in (
        # Positions and velocities have no natural bound; every bundled task would be told so.
        r"Box observation space (minimum|maximum) value is -?infinity",
        # Wrappers are what the user trains on, so they are checked as they are.
        r"is different from the unwrapped version",
        r"Not able to test alternative render modes",
        # RL614 judges this with a tolerance: float rounding, which SB3's checker does not forgive, harms nobody.
        r"The reward was not computed with `compute_reward",
        r"computation of reward differs",
    )
)
"""Complaints that say nothing about an environment's quality."""


def is_noise(complaint: Complaint) -> bool:
    """Say whether a complaint is left out."""
    return any(pattern.search(complaint.text) for pattern in NOISE)


def _require(evidence: Evidence, checker: str) -> None:
    if checker not in evidence.checkers:
        raise NotJudged(f"{checker}'s checker did not come to its end")
    if problem := evidence.checkers[checker]:
        raise NotJudged(f"{checker}'s checker could not run: {problem}")


@rule(
    "RL290",
    "Gymnasium's checker",
    Severity.WARNING,
    "See gymnasium.utils.env_checker.check_env.",
    needs=("gymnasium checker",),
)
def gymnasium(evidence: Evidence) -> Iterator[Seen]:
    """Gymnasium's check_env says something that no other rule covers."""
    _require(evidence, GYMNASIUM)
    return iter(())


@rule(
    "RL291",
    "Stable-Baselines3's checker",
    Severity.WARNING,
    "See stable_baselines3.common.env_checker.check_env.",
    needs=("sb3 checker",),
)
def stable_baselines3(evidence: Evidence) -> Iterator[Seen]:
    """Stable-Baselines3's check_env says something that no other rule covers."""
    _require(evidence, SB3)
    return iter(())


OF_CHECKER = {GYMNASIUM: gymnasium, SB3: stable_baselines3}
"""The rule that owns what is left, per checker."""
