"""Where the source throws away a part of the reward: it sets the reward where it should add to it, or computes a term
that nothing reads."""

import ast
import dataclasses
import itertools
from collections.abc import Iterator, Sequence

from rlctl.checking.assignments import Assignment
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.source_code import Function
from rlctl.checking.summands import REWARD_NAMES
from rlctl.checking.term_names import COST_WORDS, split_name

TERM_WORDS = {*COST_WORDS, "bonus", "rew", "reward"}
READ_BY_NAME = {"eval", "exec", "locals", "vars"}  # functions that may read any local variable


@dataclasses.dataclass(frozen=True, eq=False)
class DiscardedReward:
    """A statement that sets the reward, and the one before it whose value nothing reads."""

    before: Assignment
    after: Assignment


def find_discarded_rewards(notes: NotedEpisodes) -> Iterator[DiscardedReward]:
    """Yield them: both stand in the same block, and nothing between them reads the reward."""
    for function in notes.functions:
        if function not in notes.of_steps:
            continue
        for text, assignments in notes.definitions.list_assigned(function).items():
            if REWARD_NAMES & {*split_name(text)} and text.isidentifier():
                yield from _compare(notes, function, text, assignments)


def find_unread_terms(notes: NotedEpisodes) -> Iterator[Assignment]:
    """Yield what a step computes as terms of the reward and never reads, beside terms that it does read."""
    for function in notes.functions:
        if function not in notes.of_steps:
            continue
        nodes = list(ast.walk(function))
        read = {node.id for node in nodes if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Store)}
        read |= {name for node in nodes if isinstance(node, ast.Global | ast.Nonlocal) for name in node.names}
        terms = {
            name: assignments
            for name, assignments in notes.definitions.list_assigned(function).items()
            if name.isidentifier() and TERM_WORDS & {*split_name(name)}
        }
        if read & READ_BY_NAME or not read & {*terms}:
            continue
        for name, assignments in terms.items():
            if name not in read and all(_is_own(one) and _is_computed(one.value) for one in assignments):
                yield assignments[0]


def _is_own(one: Assignment) -> bool:
    """Say whether a variable gets a value of its own: what is unpacked among others, as from super().step(action),
    need not be used."""
    return one.element is None and not one.is_part


def _is_computed(node: ast.expr) -> bool:
    return any(isinstance(one, ast.Name | ast.Call) for one in ast.walk(node))


def _compare(
    notes: NotedEpisodes, function: Function, name: str, assignments: Sequence[Assignment]
) -> Iterator[DiscardedReward]:
    for before, after in itertools.pairwise(assignments):
        block = _find_block(notes, before)
        if block is None or after.statement not in block or not isinstance(after.statement, ast.Assign):
            continue
        first, last = block.index(before.statement), block.index(after.statement)
        reads = [node for one in block[first + 1 : last + 1] for node in ast.walk(one) if _reads(node, name)]
        is_constant = notes.reward.numbers.read_constant(before.value) is not None
        if first < last and not reads and _is_own(before) and not is_constant:
            yield DiscardedReward(before, after)


def _find_block(notes: NotedEpisodes, one: Assignment) -> list[ast.stmt] | None:
    """Return the statements among which an assignment stands."""
    parent = notes.source.parents[one.statement]
    for field in ("body", "orelse", "finalbody"):
        block = getattr(parent, field, None)
        if isinstance(block, list) and one.statement in block:
            return block
    return None


def _reads(node: ast.AST, name: str) -> bool:
    return isinstance(node, ast.Name) and node.id == name and isinstance(node.ctx, ast.Load)
