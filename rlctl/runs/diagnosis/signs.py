"""Signs in the tables of a run. Each function returns its evidence in numbers, or None where the sign is not there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rlctl.runs.diagnosis.history import Curve, History

Sign = Callable[[History], str | None]

_LEAST_ROWS = 10
_LEAST_RETURNS = 6
_LEAST_EVALUATIONS = 4
_NEVER = 0.02  # success rate
_GOOD = 0.8


def flat(run: History) -> str | None:
    """Neither the training's return nor the evaluations' rises, with half of the training done."""
    if run.progress < 0.5:
        return None
    training, evaluations = run.curve("return"), run.evaluation_curve("return")
    parts = []
    if len(training) >= _LEAST_RETURNS:
        if training.rise() > 2:
            return None
        first, last = training.thirds()
        parts.append(f"training return {first:.4g} in the first third, {last:.4g} in the last")
    if len(evaluations) >= _LEAST_EVALUATIONS:
        if _rank_correlation(evaluations) > 0.5 or _rises(run.evaluation_curve("success")):
            return None
        parts.append(f"evaluations from {evaluations.values[0]:.4g} to {evaluations.values[-1]:.4g}")
    if not parts or len(run.metrics) < _LEAST_ROWS or _is_good(run):
        return None
    return "; ".join(parts)


def _rank_correlation(curve: Curve) -> float:
    ranks = np.argsort(np.argsort(curve.values))
    if np.ptp(curve.values) <= 1e-9 * max(1.0, float(np.abs(curve.values).max())):
        return 0.0
    return float(np.corrcoef(np.arange(len(curve)), ranks)[0, 1])


def _rises(success: Curve) -> bool:
    return len(success) > 1 and float(success.values[1:].max() - success.values[0]) > 0.1


def _is_good(run: History) -> bool:
    return any(len(each) and each.values.max() >= _GOOD for each in _successes(run))


def _successes(run: History) -> tuple[Curve, Curve]:
    return run.evaluation_curve("success"), run.curve("success")


def never_succeeds(run: History) -> str | None:
    """Success is reported, and there is hardly any."""
    found = [each for each in _successes(run) if len(each)]
    if not found or run.progress < 0.5 or (best := max(float(each.values.max()) for each in found)) > _NEVER:
        return None
    return f"success at most {best:.1%}"


def short_episodes(run: History) -> str | None:
    """Episodes are ended early by termination, in evaluations as in training, and do not become longer."""
    lengths, evaluated, terminated = run.curve("length"), run.evaluation_curve("length"), run.curve("terminated")
    if len(lengths) < _LEAST_RETURNS or not len(evaluated) or (len(terminated) and terminated.values.mean() < 0.9):
        return None
    limit = run.env.max_steps if run.env is not None else None
    longest = limit or max(lengths.values.max(), evaluated.values.max())
    first, last = lengths.thirds()
    if last > 0.15 * longest or evaluated.values.max() > 0.15 * longest or last > 1.1 * first:
        return None
    return f"episodes last {last:.0f} steps of {longest:.0f}, {first:.0f} in the first third"


def critic_blind(run: History) -> str | None:
    """The value function explains nothing of the returns."""
    explained = run.curve("explained_variance")
    if len(explained) < _LEAST_ROWS:
        return None
    median = float(np.median(explained.values[len(explained) // 2 :]))
    return f"explained variance {median:.2f} (median of the second half)" if median < 0.1 else None


def policy_hardly_changes(run: History) -> str | None:
    """Updates change nothing, before a schedule has lowered the learning rate."""
    kl, clipped = _early(run.curve("approx_kl")), _early(run.curve("clip_fraction"))
    if len(kl) < _LEAST_ROWS or np.median(kl.values) > 1e-4 or np.median(clipped.values) > 1e-3:
        return None
    return f"approx_kl {np.median(kl.values):.1e}, clip fraction {np.median(clipped.values):.1%} (medians)"


def _early(curve: Curve) -> Curve:
    """Return the first two thirds, in which schedules still have an effect."""
    count = (2 * len(curve) + 2) // 3
    return Curve(curve.steps[:count], curve.values[:count])


def policy_jumps(run: History) -> str | None:
    """Updates change the policy several times as much as PPO is made for."""
    kl, clipped = _early(run.curve("approx_kl")), _early(run.curve("clip_fraction"))
    if len(kl) < _LEAST_ROWS or not len(clipped):
        return None
    median_kl, median_clipped = float(np.median(kl.values)), float(np.median(clipped.values))
    if median_kl < 0.2 and median_clipped < 0.55:
        return None
    return f"approx_kl {median_kl:.2g}, clip fraction {median_clipped:.0%} (medians)"


def policy_is_replaced(run: History) -> str | None:
    """Each update makes another policy of it, and none of them is good."""
    kl, clipped = _early(run.curve("approx_kl")), _early(run.curve("clip_fraction"))
    if len(kl) < _LEAST_ROWS or _is_good(run) or np.median(kl.values) < 1 or np.median(clipped.values) < 0.7:
        return None
    return f"approx_kl {np.median(kl.values):.2g}, clip fraction {np.median(clipped.values):.0%} (medians)"


def swings(run: History) -> str | None:
    """The return falls again and again by a large part of its range."""
    curve = run.curve("return") if len(run.curve("return")) >= _LEAST_ROWS else run.evaluation_curve("return")
    if len(curve) < _LEAST_RETURNS:
        return None
    spread = float(np.ptp(curve.values))
    drops = _count_drops(curve, 0.4 * spread) if spread > 0 else 0
    return f"return falls {drops} times by more than 40 % of its range of {spread:.4g}" if drops >= 3 else None


def _count_drops(curve: Curve, least: float) -> int:
    """Count falls of at least `least` from a peak, each followed by a rise of as much."""
    drops, peak, trough, falling = 0, curve.values[0], curve.values[0], False
    for value in curve.values:
        if falling:
            trough = min(trough, value)
            if value > trough + least:
                falling, peak = False, value
        else:
            peak = max(peak, value)
            if value < peak - least:
                drops, falling, trough = drops + 1, True, value
    return drops


def collapsed(run: History) -> str | None:
    """The return rose and has fallen for good, in training and in evaluations."""
    parts = []
    for curve, what, least in (
        (run.curve("return"), "training return", _LEAST_ROWS),
        (run.evaluation_curve("return"), "evaluations", _LEAST_EVALUATIONS),
    ):
        if len(curve):
            if len(curve) < least or (fall := _find_fall(curve)) is None:
                return None
            parts.append(f"{what} from {fall[0]:.4g} up to {fall[1]:.4g} at step {fall[3]:,.0f}, then {fall[2]:.4g}")
    return "; ".join(parts) or None


def _find_fall(curve: Curve) -> tuple[float, float, float, float] | None:
    """Return start, peak, end and step of the peak, of a curve that lost more than half of what it had gained."""
    window = max(2, len(curve) // 8) if len(curve) >= _LEAST_ROWS else 1
    smooth = np.convolve(curve.values, np.ones(window) / window, "valid")
    at = int(smooth.argmax())
    end = float(curve.values[-max(2, window) :].max() if len(curve) < _LEAST_ROWS else curve.values[-window:].mean())
    gained, lost = float(smooth[at] - smooth[0]), float(smooth[at]) - end
    noise = curve.noise() / window**0.5 if len(curve) >= _LEAST_ROWS else 0.0
    if (
        gained <= max(3 * noise, 0.1 * float(np.abs(curve.values).max()))
        or lost <= max(0.5 * gained, 3 * noise)
        or at + window > 0.85 * len(curve)
    ):
        return None
    return float(smooth[0]), float(smooth[at]), end, float(curve.steps[min(at + window - 1, len(curve) - 1)])


def early_peak(run: History) -> str | None:
    """The best evaluation was long ago, and those at the end are worse."""
    curve = run.evaluation_curve("return")
    if len(curve) < _LEAST_EVALUATIONS or run.progress < 0.5:
        return None
    best = int(curve.values.argmax())
    gained = float(curve.values[best] - curve.values[0])
    lost = float(curve.values[best] - curve.values[-2:].max())
    if best > 0.6 * (len(curve) - 1) or gained <= 0 or lost <= 0.2 * gained:
        return None
    return (
        f"the best evaluation, {curve.values[best]:.4g}, was at step {curve.steps[best]:,.0f} of "
        f"{curve.steps[-1]:,.0f}; the last is {curve.values[-1]:.4g}"
    )


def exploration_gone(run: History) -> str | None:
    """The policy has become all but deterministic with half of the training to go, or was so from the beginning."""
    curve = _exploration(run)
    if len(curve) < _LEAST_ROWS:
        return None
    half = curve.values[max(0, len(curve) // 2 - 2) : len(curve) // 2 + 1].mean()
    if half > 0.1 * curve.values[0] and not (curve.values[0] < 0.02 and half < 0.02):
        return None
    return f"exploration {curve.values[0]:.2g} at first, {half:.2g} half-way (1 is the half range of an action)"


def _exploration(run: History) -> Curve:
    measured = run.curve("exploration")
    return measured if len(measured) else run.curve("std")


def exploration_does_not_fall(run: History) -> str | None:
    """The policy is as random at the end as at the beginning, or more so."""
    curve = _exploration(run)
    if len(curve) < _LEAST_ROWS or run.progress < 0.5:
        return None
    first, last = curve.thirds()
    return f"exploration {first:.2g} in the first third, {last:.2g} in the last" if last >= 0.97 * first else None


def exploration_explodes(run: History) -> str | None:
    """The policy becomes far more random than the actions' range."""
    curve = _exploration(run)
    if len(curve) < _LEAST_ROWS:
        return None
    first, last = curve.thirds()
    return f"exploration grows from {first:.2g} to {last:.2g} half ranges" if last > max(2 * first, 2.0) else None


def saturated(run: History) -> str | None:
    """Nearly all actions are at a limit, in the training and where the best of them is taken."""
    curve = run.curve("action_saturation")
    if len(curve) < _LEAST_ROWS or (last := curve.thirds()[1]) < 0.8:
        return None
    return f"{last:.0%} of the actions are at a limit in the last third"


def penalties_dominate(run: History) -> str | None:
    """Of the weighted reward terms at the end, the negative ones weigh three times the positive ones."""
    means = {name: curve.thirds()[1] for name, curve in run.terms().items() if len(curve) >= 3}
    negative = -sum(value for value in means.values() if value < 0)
    positive = sum(value for value in means.values() if value > 0)
    if negative <= 3 * positive:
        return None
    worst = min(means, key=lambda name: means[name])
    return f"per episode {positive:.3g} of reward and -{negative:.3g} of penalties, {means[worst]:.3g} of it {worst}"


def episodes_shrink(run: History) -> str | None:
    """The return rises while episodes are terminated sooner and sooner."""
    lengths, terminated = run.curve("length"), run.curve("terminated")
    if len(lengths) < _LEAST_RETURNS or run.curve("return").rise() < 3:
        return None
    if len(terminated) and terminated.thirds()[1] < 0.5:
        return None
    first, last = lengths.thirds()
    return (
        f"episodes shrink from {first:.0f} to {last:.0f} steps while the return rises" if last < 0.75 * first else None
    )


def return_rises(run: History) -> str | None:
    """The training's return rises."""
    curve = run.curve("return")
    if len(curve) < _LEAST_RETURNS or curve.rise() < 3:
        return None
    first, last = curve.thirds()
    return f"return rises from {first:.4g} to {last:.4g}"


def distance_grows(run: History) -> str | None:
    """Episodes end ever farther from the goal."""
    curve = run.curve("distance")
    if len(curve) < _LEAST_RETURNS or run.progress < 0.5 or curve.rise() < 3:
        return None
    first, last = curve.thirds()
    return f"the distance to the goal grows from {first:.3g} to {last:.3g}" if last > 1.2 * first else None


def time_limit_terminates(run: History) -> str | None:
    """Every episode ends at the same step, and is said to be terminated: a time limit that is not truncation."""
    lengths, terminated = run.curve("length"), run.curve("terminated")
    if len(lengths) < 5 or len(terminated) < 5 or np.ptp(lengths.values) > 0 or terminated.values.min() < 1:
        return None
    return f"all episodes end at step {lengths.values[0]:.0f}, and all are reported as terminated, none as truncated"
