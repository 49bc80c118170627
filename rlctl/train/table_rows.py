"""The columns of `metrics.csv` and `evals.csv`, beside those of steps, time and stage."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rlctl.eval.statistics import mean_return, mean_terms, success_rate
from rlctl.rollout.messages import EpisodeResult

_LOSSES = (
    "learning_rate", "loss", "policy_gradient_loss", "policy_loss", "value_loss", "entropy_loss", "approx_kl",
    "clip_fraction", "clip_range", "explained_variance", "std", "actor_loss", "critic_loss", "ent_coef",
    "ent_coef_loss", "n_updates",
)  # fmt: skip


def training_row(recent: Sequence[EpisodeResult], terms: Iterable[str], log: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the episodes that ended lately have come to, and what SB3 logged of the last update.

    `terms` are the names of the reward terms; missing values are None.
    """
    means = mean_terms(recent) if recent else {}
    return {
        "acting": float(np.mean([each.acting for each in recent])) if recent else None,
        "return": mean_return(recent) if recent else None,
        "length": _mean_length(recent) if recent else None,
        "success": success_rate(recent) if recent else None,
        "distance": _mean_distance(recent),
        **{f"term/{name}": means.get(name) for name in terms},
        **{name: log.get(f"train/{name}") for name in _LOSSES},
    }


def tensorboard_values(row: Mapping[str, Any]) -> dict[str, float]:
    """Return what TensorBoard gets of a row of metrics, by its tags, beside what SB3 and `measurements` log."""
    tags = {"distance": "rollout/final_distance", "stage": "curriculum/stage"}
    tags |= {name: f"reward_terms/{name.removeprefix('term/')}" for name in row if name.startswith("term/")}
    return {tag: row[name] for name, tag in tags.items() if row.get(name) is not None}


def evaluation_row(results: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Return what the episodes of an evaluation have come to."""
    return {
        "episodes": len(results),
        "success": success_rate(results),
        "return": mean_return(results),
        "length": _mean_length(results),
        "distance": _mean_distance(results),
        "overlap": _median_overlap(results),
        **{f"term/{name}": value for name, value in mean_terms(results).items()},
    }


def _mean_length(results: Sequence[EpisodeResult]) -> float:
    return float(np.mean([result.length for result in results]))


def _median_overlap(results: Sequence[EpisodeResult]) -> float | None:
    """Return the median over episodes of how far bodies overlapped at most [m]; None where no episode was measured."""
    depths = [result.deepest_contact for result in results if result.deepest_contact is not None]
    return float(np.median(depths)) if depths else None


def _mean_distance(results: Sequence[EpisodeResult]) -> float | None:
    """Return the mean distance to the goal at the end; None where the environment reports none."""
    distances = [result.final_distance for result in results if result.final_distance is not None]
    return float(np.mean(distances)) if distances else None
