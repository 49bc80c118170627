"""Where the source turns a vector of the world by an orientation itself, instead of its inverse."""

from collections.abc import Iterator

from rlctl.checking.source_mistakes import FRAME_RULES, SourceMistake
from rlctl.checking.turn_directions import Directions
from rlctl.checking.turned_expressions import find_turns
from rlctl.checking.vector_series import VectorSeries, list_words
from rlctl.checking.world_vectors import WorldVectors

WORLD_WORDS = {"world", "global", "inertial", "map"}


class TurnedVectors:
    """All turns of vectors in a source, with their directions."""

    def __init__(self, series: VectorSeries) -> None:
        self.series, self.directions, self.world = series, Directions(series), WorldVectors(series)
        self.turns = list(find_turns(series))
        self.known = [(turn, self.directions.find(turn)) for turn in self.turns]


def find_wrong_turns(turned: TurnedVectors) -> Iterator[SourceMistake]:
    """Yield the turns of vectors of the world by the orientation itself, instead of its inverse."""
    series, directions, world, known = turned.series, turned.directions, turned.world, turned.known
    explained = [(turn, found, world.explain(turn)) for turn, found in known if found is not None]
    rights = {found[1] for _, found, what in explained if found[0] < 0 and what is not None}
    rights |= {found[1] for turn, found, _ in explained if found[0] > 0 and world.is_velocity(turn.turned_back)}
    seen, rights_3d = set[int](), {one.text for one in series.orientations}
    for turn, by in ((turn, found[1]) for turn, found in known if found is not None and found[0] < 0):
        if by in rights_3d and (other := world.find_compared(turn)) is not None:
            message = (
                f"{turn.whole.text} turns {turn.text} by the inverse of {by}, from the world to the body, and it is"
            )
            message += f" multiplied with {other}, which is of the world"
            yield SourceMistake("RL124", message, {"element": turn.whole.text, "value": turn.text}, turn.whole.where)
    for turn, (sign, by), what in explained:
        if sign < 0 or what is None or turn.whole.number in seen:
            continue
        is_angle = turn.before.shape[2] == 2 or by not in rights_3d
        is_told = bool(list_words(turn.whole.node) & WORLD_WORDS) or by in rights or directions.has_engine
        if is_angle and not is_told:
            continue  # the angle may count the other way round, as that of a compass
        seen.add(turn.whole.number)
        rule = "RL125" if what.startswith("the way") else "RL124"
        message = (
            f"{turn.whole.text} turns {turn.text}, {what}, by the orientation {by}: from the body to the world, and"
        )
        message += " the vector is one of the world already"
        evidence = {"element": turn.whole.text, "value": turn.text}
        yield SourceMistake(rule, message, evidence, turn.whole.where, FRAME_RULES)
