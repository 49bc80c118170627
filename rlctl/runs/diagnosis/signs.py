"""Signs in returns, lengths and successes. Each function returns the evidence of a sign, or None without it."""

from collections.abc import Callable

import numpy as np

from rlctl.runs.diagnosis.history import LEAST_ROWS, Curve, RunHistory

Sign = Callable[[RunHistory], str | None]

_LEAST_RETURNS = 6
_LEAST_EVALUATIONS = 4
_NEVER = 0.02  # success rate
_BY_CHANCE = 0.1  # success rate
_HALF = 0.5  # success rate
_LEAST_TO_FALL = 3  # points of a curve
_CLEAR = 5.0  # [standard errors]
_LARGE_FALL = 0.4  # fraction of the largest return
_SAME = 0.1  # difference of success rates of evaluations that chance explains


def flat(run: RunHistory) -> str | None:
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
    if not parts or len(run.metrics) < LEAST_ROWS or run.is_good:
        return None
    return "; ".join(parts)


def never_rises(run: RunHistory) -> str | None:
    """The training began with an untrained policy, and its return never rises above the first one.

    A training that learns before its first evaluation is flat too, but its first return is low.
    """
    curve = run.curve("return")
    if len(curve) < LEAST_ROWS or run.stage_count or run.status.get("from") or run.status.get("demos"):
        return None
    window = max(2, len(curve) // 8)
    best = float(np.convolve(curve.values[1:], np.full(window, 1 / window), "valid").max())
    if best > curve.values[0] + 2 * curve.noise():
        return None
    return f"training return {curve.values[0]:.4g} at first, {best:.4g} at best later"


def learned_little(run: RunHistory) -> str | None:
    """The training is over; success is rare, or where none is reported the return is that of the beginning."""
    if run.progress < 1 or run.is_good:
        return None
    if any(len(curve) for curve in run.successes):
        return seldom_succeeds(run)
    curve = run.curve("return")
    if len(curve) < _LEAST_TO_FALL:
        curve = run.evaluation_curve("return")
    if len(curve) < _LEAST_TO_FALL:
        return None
    first, last = float(curve.values[0]), curve.thirds()[1]
    if last > first + 3 * curve.noise():
        return None
    return f"return {first:.4g} at first, {last:.4g} in the last third"


def no_longer_rises(run: RunHistory) -> str | None:
    """Evaluations reach the time limit, but their return hardly rises after the middle of the training."""
    returns, lengths = run.evaluation_curve("return"), run.evaluation_curve("length")
    if len(returns) < _LEAST_EVALUATIONS or run.progress < 0.5 or run.is_good:
        return None
    limit = run.env.max_steps if run.env is not None else None
    third = len(returns) // 3
    before, last = float(returns.values[third:-third].mean()), float(returns.values[-third:].mean())
    if limit is None or lengths.values[-third:].mean() < 0.9 * limit or last - before > 0.1 * abs(last):
        return None
    return f"evaluations return {before:.4g} in the middle third and {last:.4g} in the last"


def _rank_correlation(curve: Curve) -> float:
    ranks = np.argsort(np.argsort(curve.values))
    if np.ptp(curve.values) <= 1e-9 * max(1.0, float(np.abs(curve.values).max())):
        return 0.0
    return float(np.corrcoef(np.arange(len(curve)), ranks)[0, 1])


def _rises(success: Curve) -> bool:
    return len(success) > 1 and float(success.values[1:].max() - success.values[0]) > 0.1


def success_rises(run: RunHistory) -> str | None:
    """The success rate of the evaluations rises, so the policy does more than collect a constant reward."""
    success = run.evaluation_curve("success")
    if len(success) < 2 or not _rises(success):
        return None
    return f"success of the evaluations rises from {success.values[0]:.1%} to {success.values[1:].max():.1%}"


def never_succeeds(run: RunHistory) -> str | None:
    """Success is reported, but hardly any episode succeeds."""
    curves = [curve for curve in run.successes if len(curve)]
    if not curves or run.progress < 0.5 or (best := max(float(curve.values.max()) for curve in curves)) > _NEVER:
        return None
    return f"success at most {best:.1%}"


def seldom_succeeds(run: RunHistory) -> str | None:
    """Success is reported, and fewer than half of the episodes succeed at best."""
    curves = [curve for curve in run.successes if len(curve)]
    if not curves or run.progress < 0.5 or (best := max(float(curve.values.max()) for curve in curves)) >= _HALF:
        return None
    return f"success at most {best:.1%}"


def succeeds_by_exploring(run: RunHistory) -> str | None:
    """Training episodes succeed with exploration noise, but evaluations never do, up to the end."""
    evaluated, trained, reached = run.evaluation_curve("success"), run.curve("success"), run.curve("stage")
    successes = trained.values
    if run.stage_count and len(reached):  # the last stage is the one that is evaluated
        successes = successes[np.isin(trained.steps, reached.steps[reached.values == run.stage_count])]
    if run.progress < 1 or len(evaluated) < _LEAST_EVALUATIONS or not len(successes):
        return None
    best = float(successes.max())
    if evaluated.values.max() > _NEVER or best < _BY_CHANCE:
        return None
    return f"success at most {evaluated.values.max():.1%} in {len(evaluated)} evaluations, {best:.0%} while training"


def short_episodes(run: RunHistory) -> str | None:
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


def swings(run: RunHistory) -> str | None:
    """The return falls again and again by a large part of its range."""
    curve = run.curve("return") if len(run.curve("return")) >= LEAST_ROWS else run.evaluation_curve("return")
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


def collapsed(run: RunHistory) -> str | None:
    """The return rose, then fell and did not recover, in training and in evaluations."""
    parts = []
    for curve, what, least in (
        (run.curve("return"), "training return", LEAST_ROWS),
        (run.evaluation_curve("return"), "evaluations", _LEAST_EVALUATIONS),
    ):
        if len(curve):
            if len(curve) < least or (fall := _find_fall(curve)) is None:
                return None
            parts.append(
                f"{what}: {fall[0]:.4g} at first, {fall[1]:.4g} at step {fall[3]:,.0f}, {fall[2]:.4g} at the end"
            )
    return "; ".join(parts) or None


def _find_fall(curve: Curve) -> tuple[float, float, float, float] | None:
    """Return start, peak, end and step of the peak, if the curve lost more than half of its gain."""
    window = max(2, len(curve) // 8) if len(curve) >= LEAST_ROWS else 1
    smooth = np.convolve(curve.values, np.ones(window) / window, "valid")
    at = int(smooth.argmax())
    end = float(curve.values[-max(2, window) :].max() if len(curve) < LEAST_ROWS else curve.values[-window:].mean())
    gained, lost = float(smooth[at] - smooth[0]), float(smooth[at]) - end
    noise = curve.noise() / window**0.5 if len(curve) >= LEAST_ROWS else 0.0
    if (
        gained <= max(3 * noise, 0.1 * float(np.abs(curve.values).max()))
        or lost <= max(0.5 * gained, 3 * noise)
        or at + window > 0.85 * len(curve)
    ):
        return None
    return float(smooth[0]), float(smooth[at]), end, float(curve.steps[min(at + window - 1, len(curve) - 1)])


def return_falls(run: RunHistory) -> str | None:
    """The return is far lower at the end than at the beginning; three rows suffice."""
    curve = run.curve("return")
    if len(curve) < _LEAST_TO_FALL:
        curve = run.evaluation_curve("return")
    if len(curve) < _LEAST_TO_FALL or run.is_good:
        return None
    first, last = curve.thirds()
    is_large = first - last > _LARGE_FALL * float(np.abs(curve.values).max())
    if not is_large and curve.rise() > -_CLEAR:
        return None
    return f"return falls from {first:.4g} to {last:.4g} at step {curve.steps[-1]:,.0f}"


def ends_low(run: RunHistory) -> str | None:
    """The training is over, and in its second half the success rate neither rose nor reached a half."""
    curve = run.evaluation_curve("success")
    if len(curve) < _LEAST_EVALUATIONS or run.progress < 1:
        return None
    second_half = curve.values[len(curve) // 2 :]
    first, last = Curve(curve.steps[-len(second_half) :], second_half).thirds()
    if curve.values.max() >= _HALF or curve.values.max() <= _NEVER or last - first > _SAME:
        return None
    return (
        f"success {second_half.min():.0%} to {second_half.max():.0%} in the last {len(second_half)} evaluations, "
        f"{curve.values.max():.0%} at best"
    )


def early_peak(run: RunHistory) -> str | None:
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


def penalties_dominate(run: RunHistory) -> str | None:
    """At the end the negative reward terms sum to more than three times the positive ones."""
    means = {name: curve.thirds()[1] for name, curve in run.terms().items() if len(curve) >= 3}
    negative = -sum(value for value in means.values() if value < 0)
    positive = sum(value for value in means.values() if value > 0)
    if negative <= 3 * positive:
        return None
    worst = min(means, key=lambda name: means[name])
    largest = f"{worst}, {means[worst]:.3g}"
    return f"per episode rewards are {positive:.3g} and penalties -{negative:.3g}; the largest penalty is {largest}"


def episodes_shrink(run: RunHistory) -> str | None:
    """The return rises while episodes are terminated sooner and sooner."""
    lengths, terminated = run.curve("length"), run.curve("terminated")
    if len(lengths) < _LEAST_RETURNS or run.curve("return").rise() < 3:
        return None
    if len(terminated) and terminated.thirds()[1] < 0.5:
        return None
    first, last = lengths.thirds()
    shrinks = last < 0.75 * first
    return f"episodes shrink from {first:.0f} to {last:.0f} steps while the return rises" if shrinks else None


def return_rises(run: RunHistory) -> str | None:
    """The training's return rises."""
    curve = run.curve("return")
    if len(curve) < _LEAST_RETURNS or curve.rise() < 3:
        return None
    first, last = curve.thirds()
    return f"return rises from {first:.4g} to {last:.4g}"


def distance_grows(run: RunHistory) -> str | None:
    """Episodes end farther and farther from the goal."""
    curve = run.curve("distance")
    if len(curve) < _LEAST_RETURNS or run.progress < 0.5 or curve.rise() < 3:
        return None
    first, last = curve.thirds()
    return f"the distance to the goal grows from {first:.3g} to {last:.3g}" if last > 1.2 * first else None


def time_limit_terminates(run: RunHistory) -> str | None:
    """Every episode ends at the same step as terminated: a time limit that should truncate."""
    lengths, terminated = run.curve("length"), run.curve("terminated")
    if len(lengths) < 5 or len(terminated) < 5 or np.ptp(lengths.values) > 0 or terminated.values.min() < 1:
        return None
    return f"all episodes end at step {lengths.values[0]:.0f}, and all are reported as terminated, none as truncated"
