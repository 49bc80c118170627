"""RL122: command is shown one step late."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.held import HeldEpisode
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL122",
    "command is shown one step late",
    Severity.WARNING,
    meaning="""
        The reward follows a new command, goal or phase one step before the observation shows it. The check put the
        robot back to its start before every step, so that nothing but these could change: each time the reward
        jumped a step before the observation. In that step the policy is judged by what it cannot know; most often
        step observes before it draws the new command, and rewards after.
    """,
    fix="""
        Draw the new command after the reward and before the observation, so that the observation that step returns
        has the command by which the next step is judged.
    """,
)

REST = 5  # So many steps before and after a jump nothing changes
FEWEST_JUMPS = 3
STILL = 1e-6
Flags = NDArray[np.bool_]


@judges_records(RULE, "episodes", "held")
def _find_late_commands(records: Records) -> Iterator[RuleFinding]:
    if any(finding.rule == "RL115" for finding in records.findings):
        return  # all that is observed is late
    episodes: Sequence[HeldEpisode] = records.require_fact("held")
    late = 0
    shown: list[tuple[HeldEpisode, int]] = []
    for episode in episodes:
        if episode.moves:
            continue
        observed = np.flatnonzero(_find_jumps(episode.observed[1:])) + 2  # the steps that return the new values
        rewarded = set((np.flatnonzero(_find_jumps(episode.rewards[:, None])) + 2).tolist())
        for step in observed.tolist():
            if step - 1 in rewarded and step not in rewarded:
                late += 1
                shown.append((episode, step))
            else:
                return
    if late >= FEWEST_JUMPS:
        episode, step = shown[0]
        before, after = episode.rewards[step - 3], episode.rewards[step - 2]
        jump = f"at step {step - 1} the reward jumps from {before:.4g} to {after:.4g}"
        message = f"{jump}, and at step {step} the observation shows why; so it is {late} of {late} times"
        evidence = {"seed": episode.seed, "step": step - 1, "value": float(after), "expected": float(before)}
        yield RuleFinding(RULE, message, evidence)


def _find_jumps(rows: NDArray[np.float64]) -> Flags:
    """Return between which rows a number changes that is still before and after. Shape (n - 1,); of rows: (n, m)."""
    size = np.maximum(1.0, np.abs(rows).max(axis=0, initial=0.0))
    changes = ~(np.abs(np.diff(rows, axis=0)) <= STILL * size)
    jumps = np.zeros(changes.shape[0], np.bool_)
    for at, column in np.argwhere(changes).tolist():
        around = changes[max(0, at - REST) : at + REST + 1, column]
        jumps[at] |= around.sum() == 1 and REST <= at < len(changes) - REST
    return jumps
