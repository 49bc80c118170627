"""RL630: cost with a sign."""

import ast
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rlctl.checking.assignments import CONVERSIONS
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.action_effects import ActionTrials, judges_actions
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.paid_errors import ErrorReader
from rlctl.checking.records import CheckedEpisode, ChildMessage, Records
from rlctl.checking.rewards import RAW_TERMS, TERMS, WITH_SEARCH, find_terms, has_terms, require_rewarded
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.signed_costs import SignedCostReader
from rlctl.checking.term_names import is_about_actions, is_cost, is_error, split_name
from rlctl.checking.term_weights import list_methods
from rlctl.checking.transitions import find_float_leaves
from rlctl.checking.values import find_author
from rlctl.checking.worlds import Array

RULE = Rule(
    "RL630",
    "cost with a sign",
    Severity.WARNING,
    meaning="""
        A cost is the sum of actions, or of elements of the observation, with their signs: where they are negative it
        pays. The policy learns full reverse, or to swing to one side. Judged are terms in info['reward_terms'] that are
        such a sum in all steps and are named after a cost, or have a negative weight in a task; and lines of step that
        subtract the plain sum of the action from the reward, where the action may be negative, or any sum whose
        numbers, and which itself, had both signs; or one number that has both, such as the sine of a tilt or a velocity
        to the side.
    """,
    fix="Sum squares or sizes: np.sum(np.square(action)), or np.sum(np.abs(action)).",
)

LONGEST = 12  # elements of a sum
MOST_ELEMENTS = 200
EXACT = 1e-4  # of the term's size
BOTH = 0.05  # part of the largest size that a term has on either side of 0
FEWEST_STEPS, MOST_STEPS = 50, 2_000
SUMS = {"sum", "mean", "nansum", "nanmean", "average"}
ACTION_NAMES = {"action", "actions", "act", "a", "u", "ctrl", "control", "controls"}
REWARD_WORDS = {"reward", "rewards", "rew"}


@judges_records(RULE, *WITH_SEARCH)
def _find_signed_terms(records: Records) -> Iterator[RuleFinding]:
    episodes = [episode for episode in require_rewarded(records) if has_terms(episode)]
    built = records.require_built()
    leaves = find_float_leaves(built.leaves)
    episodes = [one for one in episodes if _is_whole(one, leaves)]
    if sum(one.steps for one in episodes) < FEWEST_STEPS:
        return
    sizes = [int(np.prod(built.leaves[leaf].shape)) for leaf in leaves]
    names = [built.element(leaf, flat) for leaf, size in zip(leaves, sizes, strict=True) for flat in range(size)]
    observed = np.concatenate([np.hstack([one.observations[leaf].rows[1:] for leaf in leaves]) for one in episodes])
    taken = np.concatenate([one.taken for one in episodes])
    rows = np.linspace(0, len(taken) - 1, min(len(taken), MOST_STEPS)).astype(int)
    for name in find_terms(episodes[0]):
        weighted, raw = (_join(episodes, name, kind) for kind in (TERMS, RAW_TERMS))
        if weighted is None or not _is_cost(name, weighted, raw) or not _has_both_signs(weighted):
            continue
        actions = _find_sum(taken[rows], weighted[rows], [f"action[{i}]" for i in range(taken.shape[1])])
        has_negative_weight = raw is not None
        least = 2 if has_negative_weight and not is_error(name) else 1
        of_what = actions or _find_sum(observed[rows, :MOST_ELEMENTS], weighted[rows], names[:MOST_ELEMENTS], least)
        if of_what:
            message = f"reward term {name!r} is the sum of {of_what} with their signs: it costs up to"
            message += f" {-weighted.min():.4g} and pays up to {weighted.max():.4g}"
            yield RuleFinding(RULE, message, {"term": name, "value": float(weighted.max()), "expected": "at most 0"})


def _is_whole(episode: CheckedEpisode, leaves: Sequence[int]) -> bool:
    series = [episode.observations.get(leaf) for leaf in leaves]
    return bool(leaves) and all(one is not None and len(one.values) == episode.steps + 1 for one in series)


def _join(episodes: Sequence[CheckedEpisode], name: str, kind: str) -> Array | None:
    parts = [find_terms(one, kind).get(name) for one in episodes]
    return None if any(part is None for part in parts) else np.nan_to_num(np.concatenate([*parts]))


def _is_cost(name: str, weighted: Array, raw: Array | None) -> bool:
    """Say whether a term is meant to lower the reward: by the weight that a task gives it, or by its name."""
    if raw is not None:
        return bool(weighted @ raw < 0)
    return is_about_actions(name, {"energy", "power"}) or is_cost(name) or is_error(name)


def _has_both_signs(values: Array) -> bool:
    least = BOTH * float(np.abs(values).max())
    return bool(values.min() < -least < 0 < least < values.max())


def _find_sum(columns: Array, values: Array, names: Sequence[str], least: int = 1) -> str:
    """Return which consecutive columns, at least so many, are values by a negative factor; empty if none are."""
    sums = np.hstack([np.zeros((len(columns), 1)), np.cumsum(columns, axis=1)])
    for size in range(least, min(LONGEST, columns.shape[1]) + 1):
        blocks = sums[:, size:] - sums[:, :-size]
        squares = np.square(blocks).sum(axis=0)
        factors = (blocks.T @ values) / np.maximum(squares, 1e-300)
        rest = np.abs(values[:, None] - blocks * factors).max(axis=0)
        for first in np.flatnonzero((rest <= EXACT * np.abs(values).max()) & (factors < 0)).tolist():
            last = first + size - 1
            return names[first] if size == 1 else f"{names[first]} to {names[last]}"
    return ""


@judges_actions(RULE)
def _find_signed_sums(shown: ActionTrials) -> Iterator[ChildMessage]:
    """Yield the first line that subtracts the plain sum of an action, whose elements may be negative."""
    if not all(min(dimension.bounds) < 0 < max(dimension.bounds) for dimension in shown.dimensions):
        return
    for file, method in list_methods(find_author(shown.trials.instance.env)):
        for line in sorted(_list_subtractions(method)):
            message = "the plain sum of the action is subtracted from the reward: negative actions are paid"
            yield RuleFinding(RULE, message, {"element": "the reward"}, where=(file, line))
            return


def _list_subtractions(function: ast.FunctionDef) -> Iterator[int]:
    """Yield the lines of a function that lower the reward by a sum of its action."""
    names = {argument.arg for argument in function.args.args} & ACTION_NAMES
    names = {name for name in names if all(_only_converts(value) for value in _list_assigned(function, name))}
    for node in ast.walk(function) if names else ():
        if isinstance(node, ast.AugAssign) and _is_reward(node.target):
            is_lowered = isinstance(node.op, ast.Sub)
            parts = [(node.value, is_lowered)]
        elif isinstance(node, ast.Assign) and any(_is_reward(target) for target in node.targets):
            parts = [(node.value, False)]
        else:
            continue
        if any(is_lowered and _is_sum(part, names) for part, is_lowered in _list_summands(*parts[0])):
            yield node.lineno


def _is_reward(target: ast.expr) -> bool:
    name = str(getattr(target, "id", getattr(target, "attr", "")))
    return bool(set(split_name(name)) & REWARD_WORDS)


def _list_assigned(function: ast.FunctionDef, name: str) -> Iterator[ast.expr]:
    for node in ast.walk(function):
        if isinstance(node, ast.Assign | ast.AugAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(isinstance(part, ast.Name) and part.id == name for target in targets for part in ast.walk(target)):
                yield node if isinstance(node, ast.AugAssign) else node.value  # type: ignore[misc]


def _only_converts(value: Any) -> bool:
    """Say whether an expression keeps the signs of what it is given."""
    match value:
        case ast.Name():
            return True
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if name in {*CONVERSIONS, "clamp", "clip"}:
            inner = [value.func.value] if isinstance(value.func, ast.Attribute) else []
            inner = [one for one in inner if not isinstance(one, ast.Name)]
            return all(_only_converts(one) for one in [*inner, *value.args[:1]])
    return False


def _list_summands(value: ast.expr, is_lowered: bool) -> Iterator[tuple[ast.expr, bool]]:
    """Yield the parts of a sum, and whether they are subtracted."""
    match value:
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as operator, right=right):
            yield from _list_summands(left, is_lowered)
            yield from _list_summands(right, is_lowered != isinstance(operator, ast.Sub))
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            yield from _list_summands(operand, not is_lowered)
        case ast.BinOp(left=ast.UnaryOp(op=ast.USub(), operand=operand), op=ast.Mult() as operator, right=right):
            yield from _list_summands(ast.BinOp(operand, operator, right), not is_lowered)
        case ast.Call(func=ast.Name(id="float"), args=[only]):
            yield from _list_summands(only, is_lowered)
        case _:
            yield value, is_lowered


def _is_sum(value: ast.expr, names: set[str]) -> bool:
    """Say whether a value is a number, or an attribute, times the sum of an action."""
    match value:
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            factors = [left, right]
            others = [one for one in factors if not _is_sum(one, names)]
            return len(others) == 1 and isinstance(others[0], ast.Constant | ast.Attribute | ast.Name)
        case ast.Call(func=ast.Attribute(value=ast.Name(id=owner), attr=name), args=[]) if name in SUMS:
            return owner in names
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), args=[ast.Name(id=only), *_]) if name in SUMS:
            return only in names
        case ast.Call(func=ast.Name(id="float"), args=[only]):
            return _is_sum(only, names)
    return False


@judges_expressions(RULE, decides=False)
def _find_sums_of_the_source(notes: NotedEpisodes) -> Iterator[ChildMessage]:
    """Yield the first cost of the source that is a sum with signs, by what it was worth."""
    for summand, place in notes.share(ErrorReader).find_sums():
        paid = summand.weight * notes.reward.numbers.list_values(place.node)
        message = f"reward term {summand.name!r} is a cost, and {ast.unparse(place.node)} adds up numbers with their"
        message += f" signs: it costs up to {-paid.min():.4g} and pays up to {paid.max():.4g}"
        evidence = {"term": summand.name, "value": float(paid.max()), "expected": "at most 0"}
        yield RuleFinding(RULE, message, evidence, where=notes.reward.locate(place))
        return
    for summand, place in SignedCostReader(notes).find():
        paid = summand.weight * notes.reward.numbers.list_values(summand.place.node)
        message = f"reward term {summand.name!r} is a cost, and {ast.unparse(place.node)} has a sign: it costs up to"
        message += f" {-paid.min():.4g} and pays up to {paid.max():.4g}"
        evidence = {"term": summand.name, "value": float(paid.max()), "expected": "at most 0"}
        yield RuleFinding(RULE, message, evidence, where=notes.reward.locate(summand.place))
        return
