"""Where the source turns a vector of the world by an orientation itself, instead of its inverse."""

import ast
import dataclasses
import functools
from collections.abc import Iterator

import numpy as np

from rlctl.checking.assignments import list_values, list_words
from rlctl.checking.definitions import Definitions
from rlctl.checking.rule import Rule, RuleFinding
from rlctl.checking.turn_directions import Directions
from rlctl.checking.turned_expressions import VectorTurn, find_turns, list_written_out
from rlctl.checking.vector_series import VectorSeries
from rlctl.checking.world_vectors import WorldVectors

WORLD_WORDS = {"world", "global", "inertial", "map"}
WAY = "the way"
CHANGED, FEWEST_CHANGED = 1e-3, 4  # part of its length by which no turn changes a vector; calls
FRAME_RULES = ("RL123", "RL124", "RL125", "RL127", "RL128", "RL129")
"""The rules that find vectors in wrong frames by what is observed and paid."""


class TurnedVectors:
    """All turns of vectors in a source, with their directions."""

    def __init__(self, series: VectorSeries, definitions: Definitions) -> None:
        self.series, self.directions = series, Directions(series)
        self.world = WorldVectors(series, definitions)
        self.turns = list(find_turns(series))
        self.known = [(turn, self.directions.find(turn)) for turn in self.turns]

    @functools.cached_property
    def rights(self) -> set[str]:
        """The orientations by whose inverse a vector that is known to be one of the world is turned."""
        backwards = [(turn, found[1]) for turn, found in self.known if found is not None and found[0] < 0]
        return {by for turn, by in backwards if self.world.explain(turn) is not None}


@dataclasses.dataclass(frozen=True)
class _OfWorld:
    """A turn of a vector of the world by an angle that counts in a direction which is not known."""

    turn: VectorTurn
    sign: int
    by: str
    what: str

    @property
    def is_way(self) -> bool:
        return self.what.startswith(WAY)

    @property
    def line(self) -> int:
        return self.turn.whole.node.lineno


def find_mixed_frames(rule: Rule, turned: TurnedVectors) -> Iterator[RuleFinding]:
    """Yield the axes of the body, turned by the inverse, that are multiplied with a vector of the world."""
    rights_3d = {one.text for one in turned.series.orientations}
    for turn, found in turned.known:
        if found is None or found[0] >= 0 or found[1] not in rights_3d:
            continue
        other = turned.world.find_compared(turn)
        if other is not None:
            message = (
                f"{turn.whole.text} turns {turn.text} by the inverse of {found[1]}, from the world to the body, and"
            )
            message += f" it is multiplied with {other}, which is of the world"
            yield RuleFinding(rule, message, {"element": turn.whole.text, "value": turn.text}, where=turn.whole.where)


def find_wrong_turns(rule: Rule, turned: TurnedVectors, *, of_ways: bool) -> Iterator[RuleFinding]:
    """Yield the turns of vectors of the world by the orientation itself, instead of its inverse: of the ways to places,
    or of all others."""
    series, directions, world = turned.series, turned.directions, turned.world
    explained = [(turn, found, world.explain(turn)) for turn, found in turned.known if found is not None]
    starts = {(_read_start(turn), by) for turn, (sign, by), _ in explained if sign < 0 and _read_start(turn)}
    explained = [
        (turn, found, what or (f"{WAY} {turn.text}" if (_read_start(turn), found[1]) in starts else None))
        for turn, found, what in explained
    ]
    told = {found[1] for turn, found, _ in explained if found[0] > 0 and world.is_velocity(turn.turned_back)}
    seen, rights_3d = set[int](), {one.text for one in series.orientations}
    untold = list[_OfWorld]()
    for turn, (sign, by), what in explained:
        if what is None or turn.whole.number in seen:
            continue
        is_angle = turn.before.shape[2] == 2 or by not in rights_3d
        is_told = bool(list_words(turn.whole.node) & WORLD_WORDS) or by in told or directions.has_engine
        if is_angle and not is_told and not directions.counts_forwards(by):
            untold.append(_OfWorld(turn, sign, by, what))
            continue  # the angle may count the other way round, as that of a compass
        if sign < 0:
            continue
        seen.add(turn.whole.number)
        if what.startswith(WAY) == of_ways:
            message = (
                f"{turn.whole.text} turns {turn.text}, {what}, by the orientation {by}: from the body to the world,"
            )
            message += " and the vector is one of the world already"
            evidence = {"element": turn.whole.text, "value": turn.text}
            yield RuleFinding(rule, message, evidence, where=turn.whole.where, same=FRAME_RULES)
    yield from (_tell_opposite(rule, *pair) for pair in _find_opposites(untold) if pair[0].is_way == of_ways)


def _find_opposites(untold: list[_OfWorld]) -> Iterator[tuple[_OfWorld, _OfWorld]]:
    """Yield a vector of the world that is turned by the same angle in the other direction than another one: whichever
    way the angle counts, one is wrong. It is that of the direction of which there are fewer, or the last in the file.
    """
    for by in dict.fromkeys(one.by for one in untold):
        own = [[one for one in untold if (one.by, one.sign) == (by, sign)] for sign in (1, -1)]
        if all(own):
            few, several = sorted(own, key=lambda side: (len({one.turn.whole.text for one in side}), -side[-1].line))
            yield few[-1], several[0]


def _tell_opposite(rule: Rule, one: _OfWorld, other: _OfWorld) -> RuleFinding:
    whole = one.turn.whole
    message = f"{whole.text} turns {one.turn.text}, {one.what}, by {one.by} in the other direction than"
    message += f" {other.turn.whole.text} (line {other.line}) turns {other.turn.text}, {other.what}:"
    message += " both are vectors of the world, and cannot be in one frame then"
    evidence = {"element": whole.text, "value": one.turn.text}
    return RuleFinding(rule, message, evidence, where=whole.where, same=FRAME_RULES)


def find_broken_turns(rule: Rule, turned: TurnedVectors, *, of_ways: bool) -> Iterator[RuleFinding]:
    """Yield turns that are written by elements with one wrong sign: they turn nothing."""
    for turn in list_written_out(turned.series):
        known = np.isfinite(turn.before).all(axis=2) & np.isfinite(turn.after).all(axis=2)
        before, after = (np.linalg.norm(rows[known], axis=-1) for rows in (turn.before, turn.after))
        is_broken = (np.abs(after - before) > CHANGED * before).sum() >= FEWEST_CHANGED
        is_way = turned.world.find_way(turn, needs_goal=False) is not None
        if is_broken and is_way == of_ways and turn.other is not None:
            texts = f"{turn.whole.text} and {turn.other.text}"
            message = f"{texts} are {turn.text} turned in no direction: of their four products one has the wrong sign,"
            message += (
                f" and the vector changes its length by up to {np.abs(after / np.maximum(before, 1e-9) - 1).max():.0%}"
            )
            evidence = {"element": turn.other.text, "value": turn.text}
            yield RuleFinding(rule, message, evidence, where=turn.other.where, same=FRAME_RULES)


def _read_start(turn: VectorTurn) -> str | None:
    """Return from where a way goes, as it is written; None for any other vector."""
    node = turn.part
    if isinstance(node, ast.Name):
        assigned = list_values(turn.whole.function, node.id)
        node = assigned[0] if len(assigned) == 1 else None
    match node:
        case ast.BinOp(op=ast.Sub(), right=start):
            return f"{turn.whole.function.name}: {ast.unparse(start)}"
    return None
