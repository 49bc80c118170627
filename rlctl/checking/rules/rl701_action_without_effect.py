"""RL701: action without effect."""

import ast
import itertools
from collections.abc import Iterator, Mapping
from typing import Any, Literal, get_args

import numpy as np

from rlctl.checking import action_trials
from rlctl.checking.action_trials import LONGEST_DELAY, REWARD, STAGES, ActionNumber, Trials
from rlctl.checking.assignments import list_values
from rlctl.checking.clipped_actions import ActionFollowers, ClippedAction
from rlctl.checking.experiments.action_effects import ActionTrials, judges_actions
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.records import FIRST_SEED, SECOND_SEED
from rlctl.checking.rule import OutOfTime, Rule, RuleFinding, Severity, list_names
from rlctl.checking.term_weights import list_methods
from rlctl.checking.unread_actions import find_unread_elements
from rlctl.checking.unread_followers import find_unread_followers
from rlctl.checking.values import find_author

RULE = Rule(
    "RL701",
    "action without effect",
    Severity.WARNING,
    meaning="""
        An element of the action was set to its lowest and to its highest value, and the episode stayed the same to the
        last bit. Noise on such an element only costs exploration. An element that only changes the reward of its own
        step (a cost) or its own copy in the observation moves nothing either. Or the source reads one element in two
        statements and never the one beside it, also of an attribute that follows the action. An error if no element
        does anything else: there is nothing to learn. An info if the reward of the own step can also rise, as in a
        bandit, if the source compares the element, as that of a gripper, or if all values in one half of the range do
        the same; a warning where that is so for every element, or in the upper half for some and in the lower one for
        others, or where the source clips more than a quarter of the range at one end, and does not compare the element.
    """,
    fix="""
        Use every element of the action in step(), or take it out of action_space. Look for a wrong index, a
        joint that is not the motor's, a force or gain of zero.
    """,
)

WHOLE_RANGE = (
    "Map the whole range of the action to that of the motor, middle + action * half of its range; clipping leaves a "
    "part of the action without effect. If the motor acts in one direction only, declare the range from 0 to 1."
)
MOST_DIMENSIONS = 64
ACTION_NAMES = {"a", "action", "actions", "act", "u", "cmd", "command", "ctrl"}
Effect = Literal["lasting", "reward", "cost", "copy", "none"]
"""Of a number of the action: on what follows; only on its step's reward, up or, as a cost, down; only on its own copy
in the observation; or nothing."""


@judges_expressions(RULE, decides=False)
def _judge_source(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    shape = getattr(noted.instance.env.action_space, "shape", None)
    size = int(np.prod(shape or 0))
    found = find_unread_elements(RULE, noted.source, noted.of_steps, size)
    followers = find_unread_followers(RULE, noted.definitions, noted.turned.series, noted.of_steps, size)
    clipped = map(_describe_clipped, ActionFollowers(noted).find_clipped())
    yield from itertools.islice(itertools.chain(found, followers, clipped), 1)


def _describe_clipped(clipped: ClippedAction) -> RuleFinding:
    followed, name = clipped.followed, clipped.dimension.name
    low, high = followed.dead
    dead = f"{name} from {low:.4g} to {high:.4g} has no effect, {followed.part:.0%} of its range"
    message = f"{dead}: {followed.expression.text} is {followed.limit:.4g} there"
    evidence = {"element": name, "value": [low, high]}
    return RuleFinding(RULE, message, evidence, fix=WHOLE_RANGE, where=followed.expression.where)


@judges_actions(RULE)
def _find_idle_numbers(shown: ActionTrials) -> Iterator[RuleFinding]:
    trials, every = shown.trials, shown.dimensions
    effects: dict[str, Effect] = {}
    halves: dict[str, bool] = {}  # whether it is the upper one
    why = f"only {MOST_DIMENSIONS} are compared" if len(every) > MOST_DIMENSIONS else ""
    try:
        for dimension in every[:MOST_DIMENSIONS]:
            effects[dimension.name] = _find_effect(trials, dimension)
            halves |= _find_dead_half(trials, dimension) if effects[dimension.name] == "lasting" else {}
        if "lasting" not in effects.values():
            # A choice has no zero: its first value is one like the others.
            amounts = [dimension for dimension in every if "float" in dimension.leaf.dtype]
            costly = [dimension for dimension in amounts if effects.get(dimension.name) == "reward"]
            effects |= {dimension.name: "cost" for dimension in costly if _only_costs(trials, dimension)}
    except OutOfTime:
        why = "time ran out"
        if not effects:
            raise
    left_out = f" ({len(effects)} of {len(every)} dimensions: {why})" if why else ""
    switches = _list_switches(trials.instance.env)
    waiting = [name for name, effect in effects.items() if effect == "none" and name in switches]
    if waiting and len(waiting) < len(effects):
        effects = {name: effect for name, effect in effects.items() if name not in waiting}
        message = (
            f"{list_names(waiting)} changed nothing over {STAGES[-1][1]} steps from two seeds: the source compares"
        )
        yield _finding(waiting, f"{message} it, and what follows may need a place that was not reached", Severity.INFO)
    yield from _without_effect(effects, len(every), left_out)
    if halves:
        message = f"half of the range is dead, every value there has the same effect: {list_names(list(halves))}"
        # A single motor may act in one direction only. That all do is what a clip to the wrong range leaves; that some
        # have a dead upper half and others a dead lower one, what limits of joints leave of the same range for all.
        is_all, are_both = len(halves) == len(every) > 1, len({*halves.values()}) > 1
        severity = Severity.WARNING if is_all or are_both else Severity.INFO
        yield _finding(list(halves), message, severity, fix=WHOLE_RANGE)


def _list_switches(env: Any) -> set[str]:
    """Return the elements of the action that the source compares, as a gripper's or a suction cup's: `action[3] > 0`,
    also by another name. They act only where there is something to grasp."""
    found: set[str] = set()
    for _, function in list_methods(find_author(env)):
        compared = [node.left for node in ast.walk(function) if isinstance(node, ast.Compare)]
        named = [part for node in compared if isinstance(node, ast.Name) for part in list_values(function, node.id)]
        for node in [*compared, *named]:
            match node:
                case ast.Subscript(value=ast.Name(id=name), slice=ast.Constant(value=int(index))) if (
                    name in ACTION_NAMES
                ):
                    found.add(f"action[{index}]")
    return found


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


def _find_dead_half(trials: Trials, dimension: ActionNumber) -> dict[str, bool]:
    low, high = dimension.ends

    def is_same(one: float, two: float, before: float | None = None) -> bool:
        return trials.has_same_effect(dimension, one, two, before)

    middle = (low + high) / 2
    for end, other in ((low, high), (high, low)) if "float" in dimension.leaf.dtype else ():
        is_dead = is_same(end, middle) and is_same(end, (end + middle) / 2)
        # An action that changes what is at its limit already, as a closed valve, acts after the other end.
        if is_dead and not is_same(other, (other + middle) / 2) and is_same(end, middle, before=other):
            return {f"{dimension.name} from {min(end, middle):g} to {max(end, middle):g}": end > middle}
    return {}


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


def _finding(names: list[str], message: str, severity: Severity, fix: str = "") -> RuleFinding:
    evidence = {"value": names, "seed": FIRST_SEED, "seeds": [FIRST_SEED, SECOND_SEED], "steps": STAGES[-1][1]}
    return RuleFinding(RULE, message, evidence, severity, fix)
