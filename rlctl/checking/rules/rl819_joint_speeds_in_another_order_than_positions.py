"""RL819: joint speeds in another order than positions."""

import itertools
from collections.abc import Iterator, Sequence

from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.worlds import ObservedWorld, WatchedWorlds, judges_worlds
from rlctl.checking.joint_copies import JointCopy
from rlctl.checking.paired_states import PairedStates
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL819",
    "joint speeds in another order than positions",
    Severity.WARNING,
    meaning="""
        Consecutive elements of the observation are exactly the positions of some joints, and others are exactly
        the speeds of the same joints in another order. A policy can learn from that, but a controller of the
        real robot that fills both in one order, or a term that multiplies them, mixes up the joints. Or a line of the
        source computes a force from the position of one joint of MuJoCo and from the speed of another one.
    """,
    fix="""
        Use one list of indices for both. In MuJoCo, model.jnt_qposadr and model.jnt_dofadr give the places of a
        joint in qpos and qvel.
    """,
)

FEWEST_JOINTS = 2  # in a block whose order is compared


@judges_expressions(RULE, decides=False)
def _judge_source(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    yield from itertools.islice(PairedStates(noted).find(RULE), 1)


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in watched.observed:
        yield from _find_other_order(one)


def _find_other_order(one: ObservedWorld) -> Iterator[RuleFinding]:
    """Yield a block of speeds that has the joints of a block of positions in another order."""
    blocks = _find_blocks(one.copies)
    orders = [[copy.key for copy in block] for block in blocks if not block[0].is_speed]
    for block in (block for block in blocks if block[0].is_speed):
        order = [copy.key for copy in block]
        alike = [other for other in orders if sorted(other) == sorted(order)]
        if alike and order not in alike:
            positions = next(b for b in blocks if not b[0].is_speed and [c.key for c in b] == alike[0])
            names = [", ".join(copy.joint.name for copy in some) for some in (positions, block)]
            places = [one.name_elements(some[0].column, len(some)) for some in (positions, block)]
            message = f"{places[0]} are the positions of {names[0]}; {places[1]} are the speeds of {names[1]}"
            yield RuleFinding(RULE, message, {"element": places[1], "value": names[1], "expected": names[0]})
            return


def _find_blocks(copies: Sequence[JointCopy]) -> list[list[JointCopy]]:
    """Return the longest rows of consecutive elements that are positions, or speeds, of different joints."""
    blocks: list[list[JointCopy]] = []
    for copy in copies:
        last = blocks[-1] if blocks else []
        continues = last and (last[-1].column + 1, last[-1].is_speed) == (copy.column, copy.is_speed)
        if continues and copy.key not in {other.key for other in last}:
            last.append(copy)
        else:
            blocks.append([copy])
    return [block for block in blocks if len(block) >= FEWEST_JOINTS]
