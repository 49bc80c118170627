"""RL1: observations, inside their space."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.evidence import Built, Evidence, Form, Trajectory
from rlctl.check_env.finding import Severity
from rlctl.check_env.leaves import Leaf, leaf_name
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.rules.known import built, lived

ERROR, WARNING = Severity.ERROR, Severity.WARNING

OUTSIDE = (r"not (within|match).*observation space", r"obs(ervation)? returned by.* (is not within|does not match)")
ROUNDING = 1e-6
"""Excess over a bound, relative to the bound, up to which it is float rounding."""


@dataclasses.dataclass(frozen=True)
class _Found:
    trajectory: Trajectory
    form: Form


def _forms(evidence: Evidence) -> Iterator[tuple[int, Leaf, list[_Found]]]:
    """Yield what each judgeable leaf looked like, in all episodes."""
    for index, leaf in enumerate(built(evidence).leaves):
        if leaf.supported:
            found = [
                _Found(trajectory, form)
                for trajectory in lived(evidence)
                for form in trajectory.forms
                if form.what == "observation" and form.leaf == index
            ]
            yield index, leaf, found


def _place(found: _Found) -> dict[str, Any]:
    return {**found.trajectory.place, "step": found.form.step}


def _when(step: int) -> str:
    return "from reset" if step == 0 else f"at step {step}"


@rule(
    "RL101",
    "observation shape",
    ERROR,
    "Return arrays of the shape that observation_space declares, at reset and at every step.",
    complaints=(
        *OUTSIDE,
        r"(was expecting|must be) a numpy array",
        r"Casting input x",
        r"observation keys",
        r"Expected: \(.*actual shape",
    ),
)
def shape(evidence: Evidence) -> Iterator[Seen]:
    """An observation has another structure than its space says. Learners copy observations into arrays made from
    the space: they fail, or worse, broadcast."""
    for _, leaf, forms in _forms(evidence):
        for found in forms:
            if found.form.type == "missing" or found.form.shape != leaf.shape:
                yield _wrong_shape(leaf, found)
                break
            if found.form.type == "list" or found.form.type == "tuple":
                yield _no_array(leaf, found)
                break
    for trajectory in lived(evidence):
        for form in trajectory.forms:
            if form.what == "keys":
                message = f"observation has the keys {form.type}; the space has other ones"
                yield Seen(message, {**trajectory.place, "step": form.step})
                return


def _wrong_shape(leaf: Leaf, found: _Found) -> Seen:
    form = found.form
    what = f"has shape {form.shape}" if form.shape is not None else f"is no array ({form.type})"
    if form.type == "missing":
        what = "is missing"
    message = f"{leaf_name(leaf)} {_when(form.step)} {what}; the space has shape {leaf.shape}"
    shape = None if form.shape is None else list(form.shape)
    return Seen(message, {**_place(found), "shape": shape, "expected": list(leaf.shape)})


def _no_array(leaf: Leaf, found: _Found) -> Seen:
    message = f"{leaf_name(leaf)} {_when(found.form.step)} is a {found.form.type}, not a numpy array"
    return Seen(message, {**_place(found), "type": found.form.type, "expected": "numpy.ndarray"})


@rule(
    "RL102",
    "observation dtype",
    ERROR,
    "Convert with np.asarray(..., dtype=self.observation_space.dtype) before returning.",
    complaints=(
        r"dtype to be",
        r"data type \(cannot cast\)",
        r"should be an int or np.int64",
        r"must be an int",
        *OUTSIDE,
    ),
)
def dtype(evidence: Evidence) -> Iterator[Seen]:
    """An observation has another number type than its space says. Both libraries refuse float64 for a float32
    space; a type that fits into the space's (float32 for float64) is only a warning."""
    for _, leaf, forms in _forms(evidence):
        for found in forms:
            severity = _dtype_severity(leaf, found.form)
            if severity is not None:
                message = f"{leaf_name(leaf)} {_when(found.form.step)} is {found.form.dtype}; the space is {leaf.dtype}"
                evidence_ = {**_place(found), "dtype": found.form.dtype, "expected": leaf.dtype}
                yield Seen(message, evidence_, severity)
                break


def _dtype_severity(leaf: Leaf, form: Form) -> Severity | None:
    if form.dtype is None or form.shape != leaf.shape or form.type in ("list", "tuple"):
        return None
    seen, declared = np.dtype(form.dtype), np.dtype(leaf.dtype)
    if leaf.kind != "Box":
        return None if seen.kind in "iub" else ERROR
    if seen == declared or (form.type in ("float", "int") and leaf.shape == ()):
        return None
    return WARNING if np.can_cast(seen, declared) else ERROR


@rule(
    "RL103",
    "observation out of range",
    ERROR,
    "Widen the bounds of observation_space to what really occurs (infinite where there is none), or clip the "
    "observation if the bound is real.",
    complaints=(*OUTSIDE, r"does not match the bounds"),
)
def in_range(evidence: Evidence) -> Iterator[Seen]:
    """An observation is outside the bounds of its space. Normalisation by these bounds, and whoever trusts them,
    is wrong; both libraries refuse it. Excess by float rounding alone is a warning."""
    known = built(evidence)
    for index, leaf in enumerate(known.leaves):
        if not leaf.supported:
            continue
        worst: Seen | None = None
        largest = 0.0
        steps = total = 0
        for trajectory in lived(evidence):
            series = trajectory.observations.get(index)
            if series is None:
                continue
            excess = _excess(leaf, series.values)
            outside = excess.reshape(len(excess), -1).max(axis=1, initial=0.0) > 0
            steps += int(outside.sum())
            total += len(outside)
            if excess.size and excess.max() > largest:
                largest = float(excess.max())
                worst = _out_of_range(known, index, trajectory, series.steps, series.values, excess)
        if worst is not None:
            yield dataclasses.replace(
                worst,
                message=f"{worst.message}; {steps} of {total} observations are outside",
                evidence={**worst.evidence, "observations_outside": steps, "observations": total},
            )


def _excess(leaf: Leaf, values: NDArray[Any]) -> NDArray[np.float64]:
    """How far values are outside their bounds; 0 inside, and for NaN, which is another rule's."""
    low, high = np.asarray(leaf.low, np.float64), np.asarray(leaf.high, np.float64)
    wide = values.astype(np.float64)
    with np.errstate(invalid="ignore"):
        excess = np.maximum(np.maximum(low - wide, wide - high), 0.0)
    return np.where(np.isfinite(wide), excess, 0.0)


def _out_of_range(
    known: Built,
    index: int,
    trajectory: Trajectory,
    steps: NDArray[np.int64],
    values: NDArray[Any],
    excess: NDArray[np.float64],
) -> Seen:
    leaf = known.leaves[index]
    row, *place = np.unravel_index(int(excess.argmax()), excess.shape)
    at = tuple(int(i) for i in place)
    value = float(values[(row, *at)])
    low, high = float(np.asarray(leaf.low)[at]), float(np.asarray(leaf.high)[at])
    bound = low if value < low else high
    flat = int(np.ravel_multi_index(at, leaf.shape)) if leaf.shape else 0
    element, step = known.element(index, flat), int(steps[row])
    by = abs(value - bound)
    is_rounding = np.dtype(leaf.dtype).kind == "f" and by <= ROUNDING * max(abs(bound), 1e-3)
    message = f"{element} is {value:.9g} {_when(step)}; the space allows [{low:.9g}, {high:.9g}]"
    return Seen(
        message + (" (float rounding)" if is_rounding else ""),
        {**trajectory.place, "step": step, "element": element, "value": value, "expected": [low, high]},
        WARNING if is_rounding else None,
    )


@rule(
    "RL104",
    "observation not finite",
    ERROR,
    "Find the division, square root or diverging simulation behind it; np.nan_to_num would only hide it.",
    complaints=(r"found (nan|inf).* in observations", *OUTSIDE),
)
def finite(evidence: Evidence) -> Iterator[Seen]:
    """An observation is NaN or infinite. One such number turns all weights of a network into NaN."""
    known = built(evidence)
    for index, _ in enumerate(known.leaves):
        for trajectory in lived(evidence):
            series = trajectory.observations.get(index)
            if series is None or series.values.dtype.kind != "f" or np.isfinite(series.values).all():
                continue
            row, flat = np.argwhere(~np.isfinite(series.values.reshape(len(series.values), -1)))[0].tolist()
            step, element = int(series.steps[row]), known.element(index, flat)
            value = str(series.values.reshape(len(series.values), -1)[row, flat])
            yield Seen(
                f"{element} is {value} {_when(step)}",
                {**trajectory.place, "step": step, "element": element, "value": value, "expected": "finite"},
            )
            break


@rule(
    "RL105",
    "observation memory reused",
    WARNING,
    "Return a copy: `return self._observation.copy(), ...`; the same for objects in info.",
    complaints=(r"share an object",),
)
def own_memory(evidence: Evidence) -> Iterator[Seen]:
    """Two observations or infos are the same memory, so that a later step changes what a buffer kept earlier."""
    known = built(evidence)
    for trajectory in lived(evidence):
        for form in trajectory.forms:
            if form.what == "memory" and form.leaf is not None:
                name = leaf_name(known.leaves[form.leaf])
                evidence_ = {**trajectory.place, "step": form.step, "steps": form.count}
                yield Seen(f"step {form.step} wrote into the memory of the {name} returned before it", evidence_)
                return


def not_judged(evidence: Evidence) -> Iterator[str]:
    """Name the parts of observations that no rule can look into."""
    if evidence.built:
        for leaf in evidence.built.leaves:
            if not leaf.supported:
                yield f"{leaf_name(leaf)}: no rule can look into a {leaf.kind} space"
