"""RL6: the reward."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import Seen, Severity, rule
from rlctl.check_env.rules.known import lived


@rule(
    "RL601",
    "reward not finite",
    Severity.ERROR,
    "Find the division, logarithm or diverging simulation behind it.",
    complaints=(r"reward is (a|an) (nan|inf)", r"found (nan|inf).* in rewards"),
)
def finite(evidence: Evidence) -> Iterator[Seen]:
    """A reward is NaN or infinite. One such number turns all weights of a network into NaN."""
    for trajectory in lived(evidence):
        wrong = np.flatnonzero(~np.isfinite(trajectory.rewards) & trajectory.reward_is_number)
        if wrong.size:
            step, value = int(wrong[0]) + 1, str(trajectory.rewards[wrong[0]])
            message = f"the reward is {value} at step {step}"
            yield Seen(message, {**trajectory.place, "step": step, "value": value, "expected": "finite"})
            return
