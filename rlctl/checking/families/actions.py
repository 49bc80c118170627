"""RL7: the actions do something."""

import contextlib
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import action_trials
from rlctl.checking.action_trials import REWARD, ActionNumber, Frame, Trials
from rlctl.checking.experiment import INSTANCES, experiment, judges_records
from rlctl.checking.instance import Context, EnvironmentRaised
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage, Fact, Records
from rlctl.checking.rule import NotApplicable, NotJudged, OutOfTime, RuleFinding, Severity, list_names

MOST_DIMENSIONS = 64
STAGES = ((FIRST_SEED, 3), (FIRST_SEED, 20), (SECOND_SEED, 60))  # seeds and steps, until a difference shows
DELAY_STEPS, NAN_STEPS = 4, 4  # Of episodes whose first action is changed, or NaN
ROUNDING = 1e-9  # up to which rewards may differ where a robot mirrors itself
LONGEST_DELAY = 4  # steps; for earlier actions in observations and for penalties on changes
Effect = Literal["lasting", "reward", "cost", "copy", "none"]
"""Of a number of the action: on what follows; only on its step's reward, up or, as a cost, down; only on its own copy
in the observation; or nothing."""


@experiment("action effects", INSTANCES, 60, "RL701", "RL115", share=4.0)
def compare_actions(context: Context) -> Iterator[ChildMessage]:
    """Play the same episode with each number of the action at other values."""
    with context.fresh() as instance:
        every = action_trials.find_dimensions(instance.action_leaves)
        if not every:
            raise NotJudged("no element of the action can be varied")
        trials = Trials(instance)
        trials.require_repeatable()
        effects: dict[str, Effect] = {}
        halves: list[str] = []
        why = f"only {MOST_DIMENSIONS} are compared" if len(every) > MOST_DIMENSIONS else ""
        try:
            yield from _late_effects(trials, every)
            for dimension in every[:MOST_DIMENSIONS]:
                effects[dimension.name] = _find_effect(trials, dimension)
                halves += _find_dead_half(trials, dimension) if effects[dimension.name] == "lasting" else []
            if "lasting" not in effects.values():
                costly = [dimension for dimension in every if effects.get(dimension.name) == "reward"]
                effects |= {dimension.name: "cost" for dimension in costly if _only_costs(trials, dimension)}
        except OutOfTime:
            why = "time ran out"
            if not effects:
                raise
    left_out = f" ({len(effects)} of {len(every)} dimensions: {why})" if why else ""
    yield from _without_effect(effects, len(every), left_out)
    if halves:
        message = f"every value in one half of the range has the same effect: {list_names(halves)}"
        yield _finding(halves, message, Severity.INFO)


@experiment("nan action", INSTANCES, 80, "RL704", share=0.2)
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
                yield RuleFinding("RL704", message, evidence, Severity.WARNING if lasts else None)


@judges_records("RL704", "nan action")
def _find_end_after_nan(records: Records) -> Iterator[RuleFinding]:
    for failure in records.failures:
        if failure.phase == "nan action" and failure.kind in ("died", "hung"):
            evidence = {**failure.place, "value": "NaN", "expected": "an exception"}
            yield RuleFinding("RL704", f"after an action of NaN, {failure.message}", evidence)
            return


@judges_records("RL705")
def _find_changed_actions(records: Records) -> Iterator[RuleFinding]:
    for episode, form in records.forms("action")[:1]:
        message = (
            f"step {form.step} wrote into the action that it was given, as did {form.count} of {episode.steps} steps"
        )
        yield RuleFinding("RL705", message, episode.at(form.step, steps=form.count))


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


def _late_effects(trials: Trials, dimensions: Sequence[ActionNumber]) -> Iterator[ChildMessage]:
    pairs, opposites = [], []
    for seed in (FIRST_SEED, SECOND_SEED, SECOND_SEED + 1):
        plain = trials.plain(seed, DELAY_STEPS)
        for end in (0, 1):
            values = {dimension: dimension.ends[end] for dimension in dimensions}
            pairs.append(action_trials.find_differences(plain, trials.with_values(seed, DELAY_STEPS, values, at=0)))
        low, high = _play_opposites(trials, dimensions, seed)
        opposites.append(action_trials.find_differences(low, high, ROUNDING))
    first = [_first_changes(pair) for pair in pairs]
    if {min(steps.values(), default=0) for steps in first} == {2}:
        message = "the first action does not change the observation before step 2: the observation is one step old"
        yield RuleFinding("RL115", message, {"seed": FIRST_SEED, "value": 2, "expected": 1, "step": 1})
        return
    # Whatever the integrator: an element that answers later, such as a position, may be what the reward depends on.
    last = {max(steps.values(), default=0) for steps in first}
    for observed in last if len(last) == 1 and 0 not in last else ():
        is_late = {observed + 1} in (_find_first_rewards(pairs), _find_first_rewards(opposites))
        yield Fact("action effects", {"observation": observed, "reward": observed + 1 if is_late else observed})


def _play_opposites(trials: Trials, dimensions: Sequence[ActionNumber], seed: int) -> list[list[Frame]]:
    """Play two episodes of zero actions, but for the first ones, which are as far from 0 to one side as to the other: a
    cost of acting, or of changing the action, is the same in both."""
    sizes = {dimension: min(map(abs, dimension.ends)) for dimension in dimensions if min(dimension.ends) < 0}
    return [
        trials.with_first(seed, DELAY_STEPS, {dimension: sign * size for dimension, size in sizes.items()})
        for sign in (-1, 1)
    ]


def _find_first_rewards(pairs: Sequence[Mapping[int, NDArray[np.intp]]]) -> set[int]:
    return {min((step for step, columns in pair.items() if REWARD in columns), default=0) for pair in pairs}


def _first_changes(differences: Mapping[int, NDArray[np.intp]]) -> dict[int, int]:
    """Return the first step at which each element of the observation differs, by column."""
    steps = sorted(differences, reverse=True)
    return {column: step for step in steps for column in differences[step].tolist() if column < REWARD}


def _find_effect(trials: Trials, dimension: ActionNumber) -> Effect:
    copies = trials.copies(dimension, FIRST_SEED, action_trials.REPEATED_STEPS, LONGEST_DELAY)
    effect: Effect = "none"
    for seed, steps in STAGES:
        plain = trials.plain(seed, steps)
        for end in dimension.ends:
            played = trials.with_values(seed, steps, {dimension: end})
            if action_trials.observations_differ(plain, played, copies):
                return "lasting"
            if action_trials.find_other_rewards(plain, played):
                effect = "reward"
            elif effect == "none" and action_trials.observations_differ(plain, played):
                effect = "copy"
    return "lasting" if effect == "reward" and _lasts(trials, dimension) else effect


def _find_dead_half(trials: Trials, dimension: ActionNumber) -> list[str]:
    low, high = dimension.ends
    copies = trials.copies(dimension, FIRST_SEED, action_trials.REPEATED_STEPS, LONGEST_DELAY)

    def is_same(one: float, two: float) -> bool:
        played = ([trials.with_values(*stage, {dimension: value}) for value in (one, two)] for stage in STAGES)
        return not any(action_trials.observations_differ(a, b, copies) for a, b in played)

    middle = (low + high) / 2
    for end, other in ((low, high), (high, low)) if "float" in dimension.leaf.dtype else ():
        if is_same(end, middle) and is_same(end, (end + middle) / 2) and not is_same(other, (other + middle) / 2):
            return [f"{dimension.name} from {min(end, middle):g} to {max(end, middle):g}"]
    return []


def _lasts(trials: Trials, dimension: ActionNumber) -> bool:
    for seed, steps in STAGES[1:]:
        plain = trials.plain(seed, steps)
        at = (len(plain) - 1) // 4
        for end in dimension.ends:
            played = trials.with_values(seed, steps, {dimension: end}, at)
            # The action of index `at` gives frame `at + 1`.
            if any(step > at + 1 + LONGEST_DELAY for step in action_trials.find_other_rewards(plain, played)):
                return True
    return False


def _only_costs(trials: Trials, dimension: ActionNumber) -> bool:
    """Say whether zero always earns as much as both ends: a cost for acting, not a choice."""
    seed, steps = STAGES[1]
    low, high = dimension.ends
    zero = trials.with_values(seed, steps, {dimension: min(max(0, low), high)})
    ends = [trials.with_values(seed, steps, {dimension: end}) for end in dimension.ends]
    few = len(zero) <= LONGEST_DELAY  # in so few steps zero may be the right answer by chance
    return not few and all(a[REWARD] >= b[REWARD] for end in ends for a, b in zip(zero, end, strict=False))


def _without_effect(effects: Mapping[str, Effect], total: int, left_out: str) -> Iterator[RuleFinding]:
    names = {kind: [name for name, effect in effects.items() if effect == kind] for kind in get_args(Effect)}
    others_last, is_useless = bool(names["lasting"]), not names["lasting"] and not names["reward"]
    for kind, what, severity in (
        ("none", "", Severity.WARNING),
        ("cost", " but its own step's reward, a cost for acting", Severity.WARNING),
        # If no action moves anything, it is a bandit, or a series that is only watched.
        ("reward", " but its own step's reward", Severity.WARNING if others_last else Severity.INFO),
        ("copy", " but its own copy in the observation", Severity.INFO),
    ):
        if names[kind]:
            is_all = len(names[kind]) == total
            shown = "no element of the action" if is_all else list_names(names[kind])
            how = f"at its lowest and highest value, over {STAGES[-1][1]} steps from two seeds"
            message = f"{shown} changes {'anything' if is_all else 'nothing'}{what}: {how}{left_out}"
            yield _finding(names[kind], message, Severity.ERROR if is_useless and not left_out else severity)


def _finding(names: list[str], message: str, severity: Severity) -> RuleFinding:
    evidence = {"value": names, "seed": FIRST_SEED, "seeds": [FIRST_SEED, SECOND_SEED], "steps": STAGES[-1][1]}
    return RuleFinding("RL701", message, evidence, severity)
