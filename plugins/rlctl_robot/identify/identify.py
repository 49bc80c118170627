"""Estimates the physical values of a task's events from a log, each with a confidence interval."""

import contextlib
import dataclasses
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rlctl import output
from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo
from rlctl.play.workers import available_cores
from rlctl_robot.identify.follow import Follower, Unknowns, describe_expected, find_unknowns, open_world
from rlctl_robot.identify.intervals import CONFIDENCE, WIDEST, explain_unknown, measure_noise
from rlctl_robot.identify.log import Array, Log, check_actions, read_log
from rlctl_robot.identify.search import Fit, search, start_search_workers

_MIN_WIDTH = 0.02
"""Smallest half width of a training interval, relative to the value: intervals leave out the model's errors."""
_MIN_MOTION = 1e-3  # [rad or m]
_PLOT_SIZE = (100, 18)
_PLOT_POINTS = 400
_LARGEST_ERROR = 0.3
"""Largest error of the positions, as a fraction of their motion in a window, with which values are worth printing."""
_NOISE_RATIO = 3.0  # a larger error than this multiple of the measured noise is the model's
_MIN_COST_RATIO = 1.05  # smallest ratio of two delays' costs that tells them apart


@dataclasses.dataclass(frozen=True)
class IdentifiedValue:
    """A value with its 95 % interval."""

    name: str
    event: str
    key: str
    value: float
    low: float
    high: float
    known: bool
    note: str = ""  # why the value is unknown: no information, or it is at the end of its search range


@dataclasses.dataclass(frozen=True)
class Identification:
    """The physical values of a task that a log determines, and how well."""

    task: str
    log: Path
    rows: int
    seconds: float
    values: list[IdentifiedValue]
    delay_event: str
    delay: int  # [control steps]
    delay_known: bool
    position_error: tuple[float, float]
    """Root mean square of the positions' error [rad or m], with the task's own values and with the identified ones."""
    velocity_error: tuple[float, float]  # [rad/s or m/s]
    motion: float  # root mean square of the positions' change since the start of their window [rad or m]
    curves: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Of the joint with the largest error: its name, its measured positions, and those simulated before and after."""

    def events(self) -> dict[str, dict[str, Any]]:
        """Return the known values as a recipe's `events`: intervals for training, at least 2 % to each side."""
        settings: dict[str, dict[str, Any]] = {}
        for value in self.values:
            if value.known:
                least = _MIN_WIDTH * abs(value.value)
                low, high = min(value.low, value.value - least), max(value.high, value.value + least)
                settings.setdefault(value.event, {})[value.key] = [_round(low), _round(high)]
        if self.delay_event and self.delay_known:
            settings[self.delay_event] = {"steps": [self.delay, self.delay]}
        return settings


def _round(value: float) -> float:
    return float(f"{value:.4g}")


def identify(
    spec: EnvSpec,
    log_file: Path,
    *,
    events: Collection[str] = (),
    seed: int = 0,
    n_workers: int | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> Identification:
    """Estimate the values of a task's events (all, or those in `events`) from a log.

    Raises `ArtifactError` for an invalid log, `UsageError` for an event or joint that the task does not have, and
    `AnswerIsNo` if the log determines none of the values, or no values make the simulation follow it.
    """
    with contextlib.closing(open_world(spec)) as env:
        unknowns = find_unknowns(env.task.events, events, spec.task)
        log = read_log(log_file, describe_expected(env, spec.task))
        space: Any = env.action_space
        check_actions(log, log_file, np.ravel(space.low), np.ravel(space.high))
        if log.positions.std(axis=0).max() < _MIN_MOTION:
            names = [parameter.name for parameter in unknowns.parameters] + [unknowns.delay] * bool(unknowns.delay)
            raise AnswerIsNo(
                f"{log_file}: nothing moves in this log, so it contains no information about "
                f"{', '.join(names)}; to create a trajectory that moves: rlctl identify {spec.task} --excite FILE"
            )
        follower = Follower(env, log, unknowns)
        with start_search_workers(spec, log, unknowns, n_workers or available_cores()) as ask:
            fits = search(ask, unknowns, 1.0 / follower.spread, seed, report)
        best = min(fits.values(), key=lambda fit: fit.cost)
        values = _estimate_values(unknowns, best)
        before, after = follower.compare(None, 0), follower.compare(best.at, best.delay)
        _check_errors(log_file, follower, log, _root_mean_squares(before)[0], _root_mean_squares(after)[0])
        delay_known = all(fit.cost > _MIN_COST_RATIO * best.cost for fit in fits.values() if fit is not best)
        if not any(value.known for value in values) and not (unknowns.delay and delay_known):
            notes = "; ".join(dict.fromkeys(value.note for value in values))
            raise AnswerIsNo(
                f"{log_file}: this log determines none of the values: {notes}\n"
                f"to create a trajectory that moves more: rlctl identify {spec.task} --excite FILE"
            )
        positions, velocities = zip(_root_mean_squares(before), _root_mean_squares(after), strict=True)
        return Identification(
            task=spec.task,
            log=log_file,
            rows=len(log.actions),
            seconds=len(log.actions) * follower.control_dt,
            values=values,
            delay_event=unknowns.delay,
            delay=best.delay,
            delay_known=delay_known,
            position_error=positions,
            velocity_error=velocities,
            motion=_root_mean_squares(follower.motion)[0],
            curves=_make_curves(log, before, after),
        )


def _check_errors(file: Path, follower: Follower, log: Log, before: float, after: float) -> None:
    """Raise `AnswerIsNo` where the simulation does not follow the log: its values are those of another motion."""
    motion = _root_mean_squares(follower.motion)[0]
    noise = float(np.sqrt(np.square(measure_noise(log.positions)).mean()))
    if after > max(_LARGEST_ERROR * motion, _NOISE_RATIO * noise):
        raise AnswerIsNo(
            f"{file}: the task does not explain this log: the simulated positions are wrong by {after:.3g} rad "
            f"(m if sliding) with the best values and by {before:.3g} with the task's own, where the joints move by "
            f"{motion:.3g} and the noise is at most {noise:.2g}: no values\n"
            "compare signs, order and scale of its actions and joints with the task's, and where the robot's "
            "targets are in the first row: rlctl takes the measured positions"
        )


def _make_curves(log: Log, before: Array, after: Array) -> dict[str, Any]:
    worst = int(np.square(before[:, : len(log.joints)]).mean(axis=0).argmax())
    measured = log.positions[1:, worst]
    return {
        "joint": log.joints[worst],
        "measured": measured.tolist(),
        "before": (measured + before[:, worst]).tolist(),
        "after": (measured + after[:, worst]).tolist(),
    }


def _root_mean_squares(errors: Array) -> list[float]:
    """Return the error of all positions, and of all velocities."""
    return np.sqrt(np.square(errors.reshape(len(errors), 2, -1)).mean(axis=(0, 2))).tolist()


def _estimate_values(unknowns: Unknowns, fit: Fit) -> list[IdentifiedValue]:
    if not unknowns.parameters:
        return []
    spans = np.array([parameter.relative_span for parameter in unknowns.parameters])
    # In units of the values' logarithms (or of the values themselves), not of positions in their ranges.
    information = fit.information / np.outer(spans, spans)
    regular = information + 1e-9 * np.trace(information) * np.eye(len(spans)) + 1e-12 * np.eye(len(spans))
    # Errors of the model and of a start state shift all rows of a window alike: they count as one sample.
    variance = fit.cost * fit.rows_per_window
    deviations = np.sqrt(variance * np.diag(np.linalg.inv(regular)))
    alone = np.sqrt(variance / np.diag(regular))  # if all other values were known
    without_trace = np.diag(information) <= 1e-9 * np.trace(information)
    deviations[without_trace] = alone[without_trace] = 1e6  # regardless of the remaining errors
    return [
        _estimate_value(unknowns, index, fit, float(deviations[index]), float(alone[index]), regular)
        for index in range(len(spans))
    ]


def _estimate_value(
    unknowns: Unknowns, index: int, fit: Fit, deviation: float, alone: float, information: Array
) -> IdentifiedValue:
    parameter, position = unknowns.parameters[index], float(fit.at[index])
    value, half = parameter.value(position), CONFIDENCE * deviation
    if parameter.is_logarithmic:
        low, high = value * np.exp(-min(half, 5.0)), value * np.exp(min(half, 5.0))
        limit = WIDEST
    else:
        low, high = value - half, value + half
        limit = WIDEST * max(abs(value), 0.1 * parameter.relative_span)
    known, note = half <= limit, ""
    if not known and CONFIDENCE * alone <= limit:
        note = explain_unknown([other.name for other in unknowns.parameters], index, information)
    elif not known:
        note = f"this log contains no information about {parameter.name}"
    elif min(position, 1 - position) < 0.005:
        end = parameter.low if position < 0.5 else parameter.high
        note = f"the estimate is at the end of its search range, {end:.3g}: the cause may be something else"
        known = False
    return IdentifiedValue(parameter.name, parameter.event, parameter.key, value, float(low), float(high), known, note)


def show(result: Identification, json: str | None) -> None:
    """Print the values with their intervals, or write them as JSON to a file or, for `-`, to stdout."""
    if output.present({**dataclasses.asdict(result), "events": result.events()}, json):
        return
    out = output.out()
    out.print(f"{result.task}: {result.log}, {result.rows:,} rows, {result.seconds:.1f} s")
    rows = [(value.name, _format_value(value)) for value in result.values]
    if result.delay_event:
        note = "" if result.delay_known else "; one step more or less fits this log as well"
        rows.append((f"{result.delay_event}.steps", f"{result.delay}{note}"))
    elif result.delay:
        rows.append(("delay of actions", f"{result.delay} control steps in this log; the task has no event of it"))
    for name, (before, after) in (("position error", result.position_error), ("velocity error", result.velocity_error)):
        rows.append((name, f"{before:.3g} -> {after:.3g}, root mean square over windows of 1 s"))
    share = result.position_error[1] / result.motion
    rows.append(
        ("motion", f"{result.motion:.3g} in the same windows; the remaining position error is {share:.2g} of it")
    )
    output.print_table(("", ""), rows, left=("",))
    if sys.stdout.isatty():
        out.print(draw_curves(result))
    out.print("\nto train with these values, add to a recipe:")
    out.print(write_fragment(result), end="")


def write_fragment(result: Identification) -> str:
    """Return the part of a recipe with the estimated values as intervals."""
    return yaml.safe_dump({"events": result.events()}, sort_keys=False, default_flow_style=None)


def _format_value(value: IdentifiedValue) -> str:
    if value.known:
        return f"{value.value:.4g}, 95 % in [{value.low:.4g}, {value.high:.4g}]"
    return f"not known: {value.note}"


def draw_curves(result: Identification) -> str:
    """Return a plot in characters of the joint with the largest error, measured and simulated."""
    import plotext

    plotext.clear_figure()
    plotext.plotsize(*_PLOT_SIZE)
    plotext.title(f"{result.curves['joint']}: position over rows")
    for label in ("measured", "before", "after"):
        plotext.plot(result.curves[label][:_PLOT_POINTS], label=label)
    return str(plotext.uncolorize(plotext.build()))
