"""Where the source throws away what it has added up for the reward, since it sets it where it should add to it."""

import ast
import dataclasses
import itertools
from collections.abc import Iterator, Sequence

from rlctl.checking.assignments import Assignment
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.source_code import Function
from rlctl.checking.summands import REWARD_NAMES
from rlctl.checking.term_names import split_name


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


def _compare(
    notes: NotedEpisodes, function: Function, name: str, assignments: Sequence[Assignment]
) -> Iterator[DiscardedReward]:
    for before, after in itertools.pairwise(assignments):
        block = _find_block(notes, before)
        if block is None or after.statement not in block or not isinstance(after.statement, ast.Assign):
            continue
        first, last = block.index(before.statement), block.index(after.statement)
        reads = [node for one in block[first + 1 : last + 1] for node in ast.walk(one) if _reads(node, name)]
        # What is unpacked among others, as from super().step(action), need not be used.
        is_counted = before.element is None and notes.reward.numbers.read_constant(before.value) is None
        if first < last and not reads and is_counted:
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
