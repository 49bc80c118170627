"""RL6: rewards that are computed afterwards, for goals that were not pursued."""

from __future__ import annotations

from collections.abc import Iterator

from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import NotApplicable, NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.results import Hindsight
from rlctl.check_env.rules.known import result

TOLERANCE = 1e-4
"""Difference between two rewards, relative to the larger one or to 1, up to which it is rounding to float32."""


@rule(
    "RL614",
    "hindsight reward differs",
    Severity.ERROR,
    "Let step() return float(self.compute_reward(achieved_goal, desired_goal, info)), and write compute_reward for "
    "arrays: -np.linalg.norm(achieved_goal - desired_goal, axis=-1).",
    needs=("hindsight",),
    complaints=(r"'float' object has no attribute 'shape'", r"vectorized computation of reward"),
)
def hindsight_reward(evidence: Evidence) -> Iterator[Seen]:
    """compute_reward gives another reward than step did, or cannot take many goals at once. Hindsight experience replay
    (HER) fills most of its buffer with rewards from there: it then learns something else than the task."""
    seen = result(evidence, Hindsight, "hindsight")
    if not seen.defined:
        raise NotApplicable("no compute_reward, or no goals in the observation")
    if not seen.steps:
        raise NotJudged("no step could be taken")
    if seen.wrong is not None:
        yield Seen(f"compute_reward: {seen.wrong}", {"steps": seen.steps})
    if seen.rewards is not None and seen.worst is not None:
        given, computed = seen.rewards
        if abs(given - computed) > TOLERANCE * max(1.0, abs(given), abs(computed)):
            message = f"the reward of step {seen.worst} is {given:.6g}, and compute_reward says {computed:.6g}"
            yield Seen(message, {"step": seen.worst, "value": computed, "expected": given})
