"""RL603: reward badly scaled."""

from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import CheckedEpisode, Records
from rlctl.checking.rewards import join_terms, require_rewarded
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL603",
    "reward badly scaled",
    Severity.WARNING,
    meaning="""
        Rewards are far outside [-10, 10]. The value network has to grow to their size first, gradients are
        clipped, and default learning rates do not fit. A single large reward at the end of an episode is common
        and no finding. An info if the recipe normalises rewards.
    """,
    fix="""
        Divide the reward by a constant so that a usual step is within [-1, 1], or normalise it (normalize: in
        the recipe, VecNormalize).
    """,
)

LARGE = 10.0  # root mean square per step; a return is up to a hundred times as much
MOST_OF = 0.5
HUGE = 1_000.0  # a single larger reward spoils the values before it


@judges_records(RULE)
def _find_badly_scaled(records: Records) -> Iterator[RuleFinding]:
    episodes = [episode for episode in require_rewarded(records) if episode.role == "episodes"]
    if not episodes:
        return
    inner = np.concatenate([episode.rewards[: episode.steps - episode.has_ended] for episode in episodes])
    size = float(np.sqrt(np.mean(inner**2))) if inner.size else 0.0
    largest = max(episodes, key=lambda episode: float(np.abs(episode.rewards).max()))
    step = int(np.abs(largest.rewards).argmax())
    value = float(largest.rewards[step])
    if size > LARGE:
        message = f"the reward per step is {size:.3g} (root mean square), up to {value:.3g}"
    elif abs(value) > HUGE:
        message = f"the reward is {value:.3g} at step {step + 1}; usual is {size:.2g}"
    else:
        return
    term = _find_largest_term(episodes)
    if term:
        message = f"{message}; most of it is the term {term!r}"
    evidence = largest.at(step + 1, value=value, root_mean_square=size, term=term, expected=[-LARGE, LARGE])
    yield RuleFinding(RULE, message, evidence, Severity.INFO if records.normalizes("reward") else Severity.WARNING)


def _find_largest_term(episodes: Sequence[CheckedEpisode]) -> str:
    """Return the term that is most of the rewards' squares; empty without terms, or if none is most of them."""
    squares = {name: float(np.nansum(values**2)) for name, values in join_terms(episodes).items()}
    largest = max(squares, key=lambda name: squares[name], default="")
    return largest if largest and squares[largest] > MOST_OF * sum(squares.values()) else ""
