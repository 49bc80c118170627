"""How an environment takes what no learner should do: it should refuse, in words."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from rlctl.check_env.evidence import Evidence, Failure
from rlctl.check_env.finding import NotApplicable, NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.results import ActionEffects, AfterEnd, AfterEndProblem, CloseTwice, NanAction, StepBeforeReset
from rlctl.check_env.rules.interface import where
from rlctl.check_env.rules.known import built, lived, result
from rlctl.check_env.studies import LIVES

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO

MUCH_LARGER = 10.0
"""A reward so many times larger than any before, or than 1, comes from a state that no episode has."""


def _ended(evidence: Evidence, study: str, doing: str) -> Iterator[Seen]:
    """Yield what ended the process, or did not come back, in a study."""
    for failure in _ends(evidence, study):
        how = f"the process {failure.error}" if failure.kind == "died" else failure.error
        yield Seen(f"{doing} {'hangs' if failure.kind == 'hung' else 'ends it all'}: {how}", where(failure), ERROR)


def _ends(evidence: Evidence, study: str) -> list[Failure]:
    built(evidence)
    return [each for each in evidence.failures if each.phase == study and each.kind in ("died", "hung")]


@rule(
    "RL212",
    "step before reset",
    INFO,
    "Raise an exception in step() while there is no episode; gymnasium.make's OrderEnforcing does.",
    needs=("step before reset",),
)
def step_before_reset(evidence: Evidence) -> Iterator[Seen]:
    """step works on an instance that was never reset: a forgotten reset trains on whatever state the constructor left.
    If it ends the process instead, there is not even a message."""
    ended = list(_ended(evidence, "step before reset", "step before reset"))
    yield from ended
    if not built(evidence).is_env:
        raise NotJudged("it is no gymnasium.Env (RL003)")
    if not ended and result(evidence, StepBeforeReset, "step before reset").raised is None:
        yield Seen("step before reset is accepted without an exception")


@rule(
    "RL213",
    "close twice",
    WARNING,
    "Remember that it is closed: set self.client = None after disconnect, and return if it is None.",
    needs=("close twice",),
)
def close_twice(evidence: Evidence) -> Iterator[Seen]:
    """A second close raises or crashes. Wrappers, `with` blocks and the interpreter's end close once more, and hide the
    error that mattered."""
    ended = list(_ended(evidence, "close twice", "a second close"))
    yield from ended
    if not ended and (raised := result(evidence, CloseTwice, "close twice").raised) is not None:
        yield Seen(f"a second close raises {raised}", {"call": "close"})


@rule(
    "RL505",
    "nonsense after the end",
    WARNING,
    "Raise an exception in step() once the episode has ended, until reset.",
    needs=(*LIVES, "after the end"),
)
def after_end(evidence: Evidence) -> Iterator[Seen]:
    """Steps after the episode's end are accepted and return what no episode has: numbers that are not finite, another
    shape, or rewards far larger than any. A loop that misses an end then learns from them. Refusing such steps is best;
    going on sanely is fine."""
    ended = list(_ended(evidence, "after the end", "step after the episode's end"))
    yield from ended
    if ended:
        return
    found = result(evidence, AfterEnd, "after the end")
    known = _kinds_in_life(evidence)
    for problem in found.problems:
        if problem.kind not in known:
            yield _problem(found, problem)
            return
    largest = max((float(np.nanmax(np.abs(each.rewards), initial=0.0)) for each in lived(evidence)), default=0.0)
    worst = max(found.rewards, key=abs, default=0.0)
    if abs(worst) > MUCH_LARGER * max(largest, 1.0):
        yield Seen(
            f"a step after the episode's end is rewarded with {worst:.6g}; no step before was with more than "
            f"{largest:.6g}",
            {"seed": found.seed, "step": found.ended + 1 + found.rewards.index(worst), "value": worst,
             "expected": largest},
        )  # fmt: skip


def _problem(found: AfterEnd, problem: AfterEndProblem) -> Seen:
    what = "has shape" if problem.kind == "shape" else "is"
    message = (
        f"{problem.what} {what} {problem.value} at step {problem.step}, after the end at step {found.ended}; it should "
        f"be {problem.expected}"
    )
    place = {"seed": found.seed, "step": problem.step}
    return Seen(message, {**place, "value": problem.value, "expected": problem.expected})


def _kinds_in_life(evidence: Evidence) -> set[str]:
    """Return the kinds of problem that episodes have already; RL101, RL103, RL104 and RL601 have those."""
    known: set[str] = set()
    leaves = built(evidence).leaves
    for trajectory in lived(evidence):
        if not np.isfinite(trajectory.rewards).all():
            known.add("not finite")
        for form in trajectory.forms:
            if form.what == "observation" and form.leaf is not None and form.shape != leaves[form.leaf].shape:
                known.add("shape")
        for index, series in trajectory.observations.items():
            values: Any = series.values.astype(np.float64)
            if not np.isfinite(values).all():
                known.add("not finite")
            leaf = leaves[index]
            if leaf.low is not None and leaf.high is not None and ((values < leaf.low) | (values > leaf.high)).any():
                known.add("outside")
    return known


@rule(
    "RL704",
    "NaN action accepted",
    WARNING,
    "Raise an exception in step() for an action that is not finite.",
    needs=("nan action", "action effects"),
)
def nan_action(evidence: Evidence) -> Iterator[Seen]:
    """An action of NaN is accepted. If finite observations come back it is swallowed: a policy that has diverged goes
    on as if nothing were wrong. If NaN comes back it spreads at least where it can be seen, though late."""
    if not any(leaf.kind == "Box" and leaf.dtype.startswith("float") for leaf in built(evidence).action_leaves):
        raise NotApplicable("no continuous action")
    if not built(evidence).is_env:
        raise NotJudged("it is no gymnasium.Env (RL003)")
    ended = list(_ended(evidence, "nan action", "an action of NaN"))
    yield from ended
    if ended:
        return
    found = result(evidence, NanAction, "nan action")
    if found.raised is not None:
        return
    effects = evidence.facts.get(ActionEffects.__name__)
    if effects is not None and all(each.effect == "none" for each in effects.dimensions):
        raise NotJudged("no action has any effect (RL701)")
    place = {"seed": found.seed, "step": found.step, "expected": "an exception"}
    if found.finite:
        yield Seen("an action of NaN is swallowed: only finite numbers come back", {**place, "value": "finite"})
    else:
        yield Seen("an action of NaN is accepted, and NaN comes back", {**place, "value": "nan"}, INFO)
