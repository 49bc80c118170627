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
        "acting": _mean(each.acting for each in recent),
        "return": mean_return(recent) if recent else None,
        "length": _mean(each.length for each in recent),
        "success": success_rate(recent) if recent else None,
        "distance": _mean(each.final_distance for each in recent),
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
    depths = [each.deepest_contact for each in results if each.deepest_contact is not None]
    return {
        "episodes": len(results),
        "success": success_rate(results),
        "return": mean_return(results),
        "length": _mean(each.length for each in results),
        "distance": _mean(each.final_distance for each in results),
        "overlap": float(np.median(depths)) if depths else None,
        **{f"term/{name}": value for name, value in mean_terms(results).items()},
    }


def _mean(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are known; None without any."""
    known = [each for each in values if each is not None]
    return float(np.mean(known)) if known else None
