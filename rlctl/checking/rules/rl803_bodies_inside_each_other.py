"""RL803: bodies inside each other."""

import itertools
from collections.abc import Collection, Iterator, Sequence

from rlctl.checking.experiments.worlds import judges_logs
from rlctl.checking.records import ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.rules.rl805_simulation_explodes import is_diverging
from rlctl.checking.rules.rl807_not_at_rest_at_reset import find_thrown
from rlctl.checking.world_logs import LASTING_STEPS, LoggedWorld, WorldLog, name_place
from rlctl.checking.worlds import Pair

RULE = Rule(
    "RL803",
    "bodies inside each other",
    Severity.WARNING,
    meaning="""
        Links stay deep inside each other for many steps with ordinary actions. The simulation answers with
        forces that no real contact has, and policies exploit them.
    """,
    fix="""
        Start without overlap (PyBullet's getClosestPoints, and in MuJoCo data.contact after mj_forward, show it), take
        shorter physics steps or more substeps, keep masses within a factor of 100 of each other, and drive joints with
        limited forces instead of resetting their state.
    """,
)

FEWEST_OVERLAPS = 2  # resets that put something into something else that moves
MOST_IN_GROUND = 0.5  # part of the resets that may put something into what never moves: feet of a robot that is tilted
ABOUT_DEEPEST = 0.99  # part of the depth: what is equally deep in many steps is so since the first of them
LASTING_SOFT = 10  # [steps]; contacts of MuJoCo are soft by design, if they begin after a reset


@judges_logs(RULE)
def _find_penetration(world: LoggedWorld) -> Iterator[ChildMessage]:
    if is_diverging(world):
        yield Skipped(RULE.id, "the simulation diverges (RL805)")  # which explains what else is odd
        return
    if all(log.times[-1] == log.times[0] for log in world.logs if len(log.times) > 1):
        return  # Nothing advances the physics: bodies are placed, and no forces push them apart.
    thrown = find_thrown(world)
    worst: dict[Pair, tuple[float, WorldLog, list[int]]] = {}
    for log in world.logs:
        for pair in {pair for deep in log.deep for pair in deep} if log.actions != "extreme" else ():
            row = _longest_row([pair in deep for deep in log.deep])
            depth = max(log.deep[i][pair][0] for i in row)
            names = [log.world.link_name(link) for link in pair]
            # What is inside each other since the reset and is thrown out is RL807.
            is_thrown = log.places[row[0]]["step"] <= 1 and any(body in name for body in thrown for name in names)
            lasting = LASTING_SOFT if world.world.engine == "MuJoCo" and log.places[row[0]]["step"] else LASTING_STEPS
            if len(row) >= lasting and not is_thrown and depth > worst.get(pair, (0.0,))[0]:
                worst[pair] = depth, log, row
    for pair, (depth, log, row) in sorted(worst.items(), key=lambda item: -item[1][0])[:1]:
        at = next(i for i in row if log.deep[i][pair][0] >= ABOUT_DEEPEST * depth)
        limit, place = log.deep[at][pair][1], log.places[at]
        names = [log.world.link_name(link) for link in sorted(pair, reverse=True)]  # what is fixed comes last
        more = f"; so are {len(worst) - 1} other pairs of links" if len(worst) > 1 else ""
        lasts = f"deeper than {100 * limit:.1f} cm for {len(row)} steps in a row{more}"
        message = f"{names[0]} is {100 * depth:.1f} cm inside {names[1]} {name_place(place)}, and {lasts}"
        yield RuleFinding(RULE, message, {**place, "value": depth, "expected": limit, "links": names})
    if not worst:
        yield from _find_overlap_at_reset(world, thrown)


def _find_overlap_at_reset(world: LoggedWorld, thrown: Collection[str]) -> Iterator[RuleFinding]:
    """Yield what resets put into each other, if the two ever touch: the engine may have been told to let them pass."""
    touching = {frozenset(pair) for log in world.logs for pairs in log.touching for pair in pairs}
    starts: dict[Pair, list[WorldLog]] = {}
    for log in world.logs:
        for pair in log.overlaps:
            is_thrown = any(body in log.world.link_name(link) for body in thrown for link in pair)  # RL807 says it
            if frozenset(pair) in touching and not is_thrown:
                starts.setdefault(pair, []).append(log)
    moving = {body.id for body in world.world.bodies if body.is_free or body.joints}
    fewest = dict.fromkeys(starts, FEWEST_OVERLAPS)
    for pair in starts:
        if not all(body in moving for body, _ in pair):
            fewest[pair] = max(FEWEST_OVERLAPS, int(MOST_IN_GROUND * len(world.logs)) + 1)
    often = [pair for pair in starts if len(starts[pair]) >= fewest[pair]]
    if not often:
        return
    pair = max(often, key=lambda pair: len(starts[pair]))
    log = max(starts[pair], key=lambda log: log.overlaps[pair][0])
    (depth, limit), place = log.overlaps[pair], log.places[0]
    names = [log.world.link_name(link) for link in sorted(pair, reverse=True)]
    how_often = f"in {len(starts[pair])} of {len(world.logs)} episodes"
    message = (
        f"{names[0]} is {100 * depth:.1f} cm inside {names[1]} at reset, {how_often} more than {100 * limit:.1f} cm"
    )
    yield RuleFinding(RULE, message, {**place, "value": depth, "expected": limit, "links": names})


def _longest_row(is_deep: Sequence[bool]) -> list[int]:
    groups = itertools.groupby(range(len(is_deep)), key=is_deep.__getitem__)
    return max((list(row) for deep, row in groups if deep), key=len, default=[])
