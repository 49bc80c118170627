"""Rewards that the source clips, and that are worth the limit at every step."""

import ast
import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.assignments import read_name
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.source_code import Expression
from rlctl.checking.summands import REWARD_NAMES
from rlctl.checking.term_names import split_name

CLIPS = {"clip", "max", "maximum", "min", "minimum"}
GETTERS = {"calc", "calculate", "compute", "get"}
FEWEST = 30  # steps


@dataclasses.dataclass(frozen=True, eq=False)
class ClippedReward:
    """A reward that is the limit at every noted step, and what is clipped to it."""

    clip: Expression
    inner: Expression
    limit: float
    low: float  # of what is clipped
    high: float
    steps: int


def find_clipped_rewards(notes: NotedEpisodes) -> Iterator[ClippedReward]:
    """Yield them. What is clipped takes many values, all of them beyond the limit."""
    for clip in notes.source.expressions:
        node = clip.node
        if not isinstance(node, ast.Call) or read_name(node.func) not in CLIPS or not _is_reward(notes, clip):
            continue
        inner = [found for one in node.args if (found := notes.source.find(one)) is not None]
        clipped, values = _read(notes, clip), _read(notes, inner[0]) if len(inner) == 1 else np.empty(0)
        is_constant = len(clipped) >= FEWEST and (clipped == clipped[0]).all()
        if is_constant and len(values) == len(clipped) and np.ptp(values) > 0.0 and (values != clipped).all():
            limit, low, high = float(clipped[0]), float(values.min()), float(values.max())
            yield ClippedReward(clip, inner[0], limit, low, high, len(values))


def _is_reward(notes: NotedEpisodes, clip: Expression) -> bool:
    """Say whether a step sets the reward to an expression, or returns it as the whole reward."""
    if clip.function not in notes.of_steps:
        return False
    parent = notes.source.parents[clip.node]
    match parent:
        case ast.Assign(targets=[ast.Name(id=name) | ast.Attribute(attr=name)]):
            return bool(REWARD_NAMES & {*split_name(name)})
        case ast.Tuple(elts=[_, reward, *_]):
            return reward is clip.node and isinstance(notes.source.parents[parent], ast.Return)
        case ast.Return():
            return {*split_name(clip.function.name)} <= REWARD_NAMES | GETTERS
    return False


def _read(notes: NotedEpisodes, one: Expression) -> NDArray[np.float64]:
    """Return the values of an expression in all steps; empty where one is no number."""
    values = [value for call in notes.steps for value in call.values.get(one.number, ())]
    if any(value is None or np.size(value) != 1 for value in values):
        return np.empty(0)
    return np.array([float(np.ravel(value)[0]) for value in values if value is not None])
