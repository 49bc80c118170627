"""Signs in the recorded episodes of the last evaluations, which are played without exploration."""

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import split_names
from rlctl.play.episode import RecordedEpisode
from rlctl.runs.diagnosis.history import RunHistory

Array = NDArray[np.float64]

_LEAST_STEPS = 20
_EVERY_STEP = 0.8  # fraction of the steps; white noise reverses in 0.67, the shipped policies in 0.6
_LEAST_PAID = 0.02  # of all rewards and penalties
_LEAST_CHANGE = 0.1  # of half the action range, from step to step
_MOST_SPEED = {"m/s": 50.0, "rad/s": 300.0}  # no joint or body of a robot is faster: 300 rad/s are 2,900 turns a minute
_MOST_POSITION_SPEED = 50.0  # [m/s]
_MOST_OVERLAP = 0.05  # [m]; feet that hit the ground reach 0.02, a fall 0.03


def _actions(run: RunHistory) -> list[Array]:
    """Return each episode's actions, shape (T, elements), as fractions of half their range; empty without limits."""
    if run.env is None:
        return []
    space = run.env.spaces()[1]
    if not isinstance(space, spaces.Box) or not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        return []
    middle, half = (space.high + space.low) / 2, np.maximum((space.high - space.low) / 2, 1e-12)
    long = [episode.actions for episode in run.episodes if len(episode.rewards) >= _LEAST_STEPS]
    return [((actions - middle) / half).reshape(len(actions), -1).astype(np.float64) for actions in long]


def shakes(run: RunHistory) -> str | None:
    """Actions reverse from step to step by a large part of their range."""
    changes = []
    for actions in _actions(run):
        change = np.diff(actions, axis=0)
        changes.append((float((change[1:] * change[:-1] < 0).mean()), float(np.abs(change).mean())))
    if not changes or run.progress < 0.5:
        return None
    reversals, size = np.median(changes, axis=0)
    if reversals < 0.6 or size < 0.4:
        return None
    return (
        f"actions change direction in {reversals:.0%} of the steps, on average by {size:.2g} of half the action range"
    )


def alternates(run: RunHistory) -> str | None:
    """An action changes its direction in nearly every step; no motor or robot can follow that."""
    measured = [_measure_changes(actions) for actions in _actions(run)]
    if not measured:
        return None
    reversals, sizes = np.median(measured, axis=0)
    alternating = np.flatnonzero((reversals >= _EVERY_STEP) & (sizes >= _LEAST_CHANGE))
    if not len(alternating):
        return None
    worst = int(alternating[sizes[alternating].argmax()])
    return (
        f"action {worst} changes direction in {reversals[worst]:.0%} of the steps, on average by {sizes[worst]:.2g} "
        f"of half its range ({len(alternating)} of {len(sizes)} actions do so)"
    )


def _measure_changes(actions: Array) -> Array:
    """Return the fraction of steps that reverse each action, and the mean size of its changes, shape (2, elements)."""
    change = np.diff(actions, axis=0)
    reversals = (change[1:] * change[:-1] < 0).mean(axis=0)
    return np.stack([reversals, np.abs(change).mean(axis=0)])


def stands_still(run: RunHistory) -> str | None:
    """The actions are nearly zero."""
    sizes = [float(np.abs(actions).mean()) for actions in _actions(run)]
    if not sizes or run.progress < 0.5 or (largest := max(sizes)) > 0.05:
        return None
    return f"the mean size of actions is {largest:.1%} of half the action range"


def mostly_constant_reward(run: RunHistory) -> str | None:
    """Most of the positive reward is the same in every step, whatever the policy does."""
    return _describe_constant_reward(run, 0.7)


def only_constant_reward(run: RunHistory) -> str | None:
    """Nearly all of the positive reward is the same in every step."""
    return _describe_constant_reward(run, 0.9)


def _describe_constant_reward(run: RunHistory, least: float) -> str | None:
    weights = run.env.reward_weights if run.env is not None else {}
    shares = [share for episode in run.episodes if (share := _constant_share(episode, weights)) is not None]
    if not shares or (share := float(np.median(shares))) < least:
        return None
    return f"{share:.0%} of the positive reward is the same in every step"


def _constant_share(episode: RecordedEpisode, weights: dict[str, float]) -> float | None:
    if len(episode.rewards) < _LEAST_STEPS or not episode.info.term_names:
        return None
    weighted = episode.terms * np.array([weights.get(name, 1.0) for name in episode.info.term_names])
    inner = weighted[:-1]  # the last step may have a reward for the end
    positive = np.maximum(inner, 0).sum(axis=0)
    constant = inner.std(axis=0) <= 0.05 * np.abs(inner.mean(axis=0))
    total = float(positive.sum())
    if total <= _LEAST_PAID * float(np.abs(inner).sum()):  # hardly anything is paid: its parts say nothing
        return None
    return float(positive[constant].sum()) / total


def impossible_motion(run: RunHistory) -> str | None:
    """Speeds, or jumps of positions, that no real robot reaches."""
    if run.env is None:
        return None
    motions = []
    for episode in run.episodes:
        for name, rows in _named_observations(episode, run).items():
            motions += _fast(name, run.env.observation_units.get(name, ""), rows, run.env.control_dt)
    return max(motions)[1] if motions else None


def _fast(name: str, unit: str, rows: Array, control_dt: float | None) -> list[tuple[float, str]]:
    """Return by which factor an observation is too fast, with a sentence; empty if in fewer than two steps."""
    speeds, limit = np.abs(rows).max(axis=1), _MOST_SPEED.get(unit)
    if unit == "m" and control_dt and len(rows) > 1:
        speeds, limit = np.abs(np.diff(rows, axis=0)).max(axis=1) / control_dt, _MOST_POSITION_SPEED
    if limit is None or (speeds > limit).sum() < 2:
        return []
    kind = "m/s" if unit == "m" else unit
    return [(float(speeds.max() / limit), f"{name} moves at up to {speeds.max():,.0f} {kind} in a recorded episode")]


def bodies_overlap(run: RunHistory) -> str | None:
    """Bodies overlap far in half of the episodes of the last evaluations."""
    depths = run.evaluation_curve("overlap").values[-2:]
    if not len(depths) or (depth := float(depths.min())) < _MOST_OVERLAP:
        return None
    return f"bodies overlap by {100 * depth:.0f} cm or more in half of the episodes of the last evaluations"


def badly_scaled_observations(run: RunHistory) -> str | None:
    """Observations are not normalised, and their scales differ by a factor of 1,000."""
    settings = run.recipe.get("normalize")
    if (isinstance(settings, dict) and settings.get("observation", True)) or not run.episodes:
        return None
    deviations = [
        (float(value), f"{name}[{index}]")
        for name, rows in _named_observations(run.episodes[0], run).items()
        for index, value in enumerate(rows.std(axis=0))
        if value > 1e-9
    ]
    (least, small), (most, large) = min(deviations, default=(1.0, "")), max(deviations, default=(1.0, ""))
    if most < 1000 * least:
        return None
    return f"not normalised: the standard deviation of {large} is {most:.2g}, that of {small} is {least:.2g}"


def _named_observations(episode: RecordedEpisode, run: RunHistory) -> dict[str, Array]:
    """Return observations by name, each of shape (T + 1, elements)."""
    sizes = run.env.observation_sizes if run.env is not None else {}
    return {
        name or "observation": np.asarray(rows, np.float64).reshape(len(rows), -1)
        for name, rows in split_names(episode.observations, sizes).items()
        if rows.ndim <= 2
    }
