"""RL6: the parts of a reward, where `info["reward_terms"]` tells them (weighted, by name)."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.evidence import MOST_INFOS, Evidence, Trajectory
from rlctl.check_env.finding import NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.rules.tried import WITH_SEARCH, at, in_words, termed, terms

WARNING = Severity.WARNING

ROUNDING = 1e-5
"""How far a sum may be off, relative to the sum of all sizes: terms are often float32."""
MEANT_CONSTANT = re.compile(
    r"(^|_)(alive|aliveness|surviv\w*|time|steps?|living|life|exist\w*|constant|bias)(_|$)", re.I
)
"""Names of terms that are meant to be the same at every step."""


@rule(
    "RL607",
    "reward terms do not add up",
    WARNING,
    "Put the weighted terms into info['reward_terms'], all of them, and compute the reward as their sum.",
    needs=WITH_SEARCH,
)
def add_up(evidence: Evidence) -> Iterator[Seen]:
    """info["reward_terms"] does not sum up to the reward, so whatever is concluded from the logged terms is wrong: a
    term is missing, is there without its weight, or is counted twice."""
    lives = termed(evidence)
    if any(len(life.infos) >= MOST_INFOS for life in lives):
        raise NotJudged(f"info has more than {MOST_INFOS} numbers, not all were written down")
    worst: tuple[float, Trajectory, int, float] | None = None
    wrong = steps = 0
    for life in lives:
        values = np.stack(list(terms(life).values()))
        told = ~np.isnan(values).all(axis=0)
        sums, sizes = np.nansum(values, axis=0), np.nansum(np.abs(values), axis=0)
        off = np.where(told, np.abs(sums - life.rewards), 0.0)
        is_wrong = off > ROUNDING * np.maximum(sizes, np.abs(life.rewards))
        wrong, steps = wrong + int(is_wrong.sum()), steps + int(told.sum())
        step = int(np.where(is_wrong, off, 0.0).argmax())
        if is_wrong[step] and (worst is None or off[step] > worst[0]):
            worst = float(off[step]), life, step, float(sums[step])
    if worst is not None:
        _, life, step, total = worst
        reward = float(life.rewards[step])
        yield Seen(
            f"the terms add up to {total:.6g} at step {step + 1}, the reward is {reward:.6g}; they differ at {wrong:,} "
            f"of {steps:,} steps",
            at(
                life,
                step + 1,
                value=total,
                expected=reward,
                terms={k: _number(v[step]) for k, v in terms(life).items()},
            ),
        )


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


@rule(
    "RL612",
    "penalty that never changes",
    WARNING,
    "Look at what the penalty is computed from: a wrong slice or index of the state, a value before it is updated, or "
    "a clip that always bites.",
    needs=WITH_SEARCH,
)
def constant_penalty(evidence: Evidence) -> Iterator[Seen]:
    """A penalty in info["reward_terms"] has the same value at every step of everything that was tried, so it penalises
    nothing. One that is named for time or being alive is meant so."""
    lives = termed(evidence)
    for name, value in constants(lives).items():
        if value < 0 and not MEANT_CONSTANT.search(name):
            yield Seen(
                f"reward term {name!r} is {value:.6g} at every step of {in_words(lives)}",
                {"term": name, "value": value, "episodes": len(lives)},
            )


def constants(lives: list[Trajectory]) -> dict[str, float]:
    """Return the terms that have one value at all steps of some lives."""
    found: dict[str, list[NDArray[np.float64]]] = {}
    for life in lives:
        for name, values in terms(life).items():
            found.setdefault(name, []).append(values)
    return {
        name: float(parts[0][0])
        for name, parts in found.items()
        if len(parts) == len(lives) and all((part == parts[0][0]).all() for part in parts)
    }
