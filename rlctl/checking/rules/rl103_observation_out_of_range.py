"""RL103: observation out of range."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiment import judges_records
from rlctl.checking.observations import name_moment
from rlctl.checking.records import CheckedEpisode, Records, Series
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.environments.leaves import Leaf

RULE = Rule(
    "RL103",
    "observation out of range",
    Severity.ERROR,
    meaning="""
        An observation is outside the bounds of its space. Both libraries refuse it, and normalisation by these
        bounds is wrong. A warning for float rounding, if it is rare and not at reset, or if nothing is outside by
        more than 1 % of its range, as of a joint with soft limits; an info below half a percent, or if only the
        last observation of an episode is outside.
    """,
    fix="""
        Widen the bounds of observation_space to what really occurs (infinite if there is no bound), or clip the
        observation if the bound is real.
    """,
    is_about_space=True,
)

ROUNDING = 1e-6  # Excess over a bound, relative to the bound, up to which it is float rounding
SLIGHT = 0.01  # the same, relative to the range, up to which it is no error
UNLIMITED = """
Declare infinite bounds for an element that has none. In MuJoCo the jnt_range of a joint without limits is [0, 0]:
jnt_limited says which joints have limits.
"""
LARGE_SHARE, SMALL_SHARE = 0.1, 0.005  # of all observations but the last ones, for an error, or a warning


@judges_records(RULE)
def _find_out_of_range(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    for index, leaf in enumerate(built.leaves):
        recorded = [(*pair, _excess(leaf, pair[1])) for pair in records.series(index) if leaf.supported]
        if not any(excess.any() for *_, excess in recorded):
            continue
        trajectory, series, excess = max(recorded, key=lambda record: float(record[2].max(initial=0.0)))
        row, flat = divmod(int(excess.argmax()), excess.shape[1])
        step, value = int(series.steps[row]), float(series.rows[row, flat])
        low, high = (float(bound[flat]) for bound in leaf.flat_bounds)
        bound = low if value < low else high
        is_rounding = np.dtype(leaf.dtype).kind == "f" and abs(value - bound) <= ROUNDING * max(abs(bound), 1e-3)
        outside = np.concatenate([excess.any(axis=1) for *_, excess in recorded])
        count, total = int(outside.sum()), len(outside)
        element = built.element(index, flat)
        columns = np.flatnonzero(np.any([record[2].any(axis=0) for record in recorded], axis=0))
        others = [built.element(index, int(column)) for column in columns if column != flat]
        more = f"; so are {list_names(others)}" if others else ""
        allowed = f"the space allows [{low:.9g}, {high:.9g}]{' (float rounding)' if is_rounding else ''}"
        share = f"{count} of {total} observations are outside{more}"
        message = f"{element} is {value:.9g} {name_moment(step)}; {allowed}; {share}"
        counts = {"observations_outside": count, "observations": total}
        evidence = trajectory.at(step, element=element, value=value, expected=[low, high], **counts)
        severity = Severity.WARNING if is_rounding else _severity_of_outside(recorded, outside)
        if severity is Severity.ERROR and _is_slight(leaf, recorded):
            severity = Severity.WARNING
        has_no_range = built.model != "" and low == high == 0.0
        yield RuleFinding(RULE, message, evidence, severity, " ".join(UNLIMITED.split()) if has_no_range else "")


def _severity_of_outside(
    recorded: list[tuple[CheckedEpisode, Series, NDArray[np.float64]]], outside: NDArray[np.bool_]
) -> Severity:
    is_first = np.concatenate([series.steps == 0 for _, series, _ in recorded])
    is_last = np.concatenate([(series.steps == episode.steps) & episode.has_ended for episode, series, _ in recorded])
    share = float((outside & ~is_last).mean())
    if share >= LARGE_SHARE or (outside & is_first).any():
        return Severity.ERROR
    return Severity.WARNING if share >= SMALL_SHARE else Severity.INFO


def _is_slight(leaf: Leaf, recorded: list[tuple[CheckedEpisode, Series, NDArray[np.float64]]]) -> bool:
    low, high = leaf.flat_bounds
    largest = np.max([record[2].max(axis=0, initial=0.0) for record in recorded], axis=0)
    return bool((largest <= SLIGHT * (high - low)).all())


def _excess(leaf: Leaf, series: Series) -> NDArray[np.float64]:
    """How far values are outside their bounds; 0 inside, and for NaN, which is another rule's. Shape: (n, elements)."""
    (low, high), rows = leaf.flat_bounds, series.rows
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(rows), np.maximum(np.maximum(low - rows, rows - high), 0.0), 0.0)
