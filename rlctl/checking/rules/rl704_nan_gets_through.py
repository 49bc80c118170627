"""RL704: NaN gets through."""

import contextlib
import tempfile
from collections.abc import Iterator

import numpy as np

from rlctl.checking import action_trials
from rlctl.checking.action_trials import REWARD, Trials
from rlctl.checking.experiment import INSTANCES, experiment, judges_records
from rlctl.checking.instance import Context, EnvironmentRaised
from rlctl.checking.records import FIRST_SEED, ChildMessage, Records
from rlctl.checking.rule import NotApplicable, Rule, RuleFinding, Severity

RULE = Rule(
    "RL704",
    "NaN gets through",
    Severity.INFO,
    meaning="""
        step accepts an action of NaN, and then the observation or the reward is NaN. A policy that has diverged
        fills the training data with NaN before anything stops it. A warning if later episodes stay NaN too. Or
        step does not return, or ends the process, as a solver does that iterates until an error is small.
    """,
    fix="Refuse such an action in step: if not np.isfinite(action).all(): raise ValueError(...).",
)

NAN_STEPS = 4  # Of an episode whose first action is NaN


@experiment("nan action", INSTANCES, 80, RULE, share=0.2)
def give_nan(context: Context) -> Iterator[ChildMessage]:
    """Take an action of NaN, and then begin another episode."""
    with context.fresh() as instance:
        if not any(leaf.kind == "Box" and leaf.dtype.startswith("float") for leaf in instance.action_leaves):
            raise NotApplicable("no continuous action")
        trials = Trials(instance)
        # A simulator may write a log about it to the working directory: MuJoCo does.
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), contextlib.suppress(EnvironmentRaised):
            nan_in, lasts = _play_nan(trials)
            if nan_in:
                evidence = {"seed": FIRST_SEED, "step": 1, "value": "NaN", "expected": "an exception"}
                until = "also in later episodes" if lasts else "until the next reset"
                message = f"step accepts an action of NaN: {nan_in} NaN {until}"
                yield RuleFinding(RULE, message, evidence, Severity.WARNING if lasts else None)


@judges_records(RULE, "nan action")
def _find_end_after_nan(records: Records) -> Iterator[RuleFinding]:
    for failure in records.failures:
        if failure.phase == "nan action" and failure.kind in ("died", "hung"):
            evidence = {**failure.place, "value": "NaN", "expected": "an exception"}
            yield RuleFinding(RULE, f"after an action of NaN, {failure.message}", evidence)
            return


def _play_nan(trials: Trials) -> tuple[str, bool]:
    """Return what is NaN after a first action of NaN, and whether anything is in the next episode."""
    dimensions = action_trials.find_dimensions(trials.instance.action_leaves)
    values = {dimension: np.nan for dimension in dimensions if "float" in dimension.leaf.dtype}
    frames = [~np.isfinite(frame) for frame in trials.with_values(FIRST_SEED, NAN_STEPS, values, at=0)[1:]]
    names = ["observation"] if any(frame[:REWARD].any() for frame in frames) else []
    names += ["reward"] if any(frame[REWARD] for frame in frames) else []
    if not names:
        return "", False
    later = trials.play(FIRST_SEED, trials.actions(FIRST_SEED, NAN_STEPS))
    verb = "are" if len(names) > 1 else "is"
    return f"the {' and the '.join(names)} {verb}", not all(np.isfinite(frame).all() for frame in later)
