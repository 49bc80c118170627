"""RL626: success of another link."""

from collections.abc import Iterator, Mapping

import numpy as np

from rlctl.checking.experiments.goals import (
    NEAR,
    PLACED_STEPS,
    GoalEpisode,
    GoalTrials,
    Source,
    judges_goals,
)
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.transitions import find_float_leaves
from rlctl.checking.workspaces import find_objects

RULE = Rule(
    "RL626",
    "success of another link",
    Severity.WARNING,
    meaning="""
        The observation shows the way from one link to the goal, and is_success is true where another link is at
        the goal. The check put the goal at each link to see it. Most often a link's index or name is that of its
        neighbour, or what was meant is the tip, and what is read is the body that carries it. The same of an
        object: its way to the goal is observed, or it is the achieved_goal, and success is where the hand is.
    """,
    fix="Use the same link, and the same point of it, in the observation, in the reward and for success.",
)

EPISODES = 3


@judges_goals(RULE)
def _find_other_link(trials: GoalTrials) -> Iterator[ChildMessage]:
    """Put the goal at each link of a fixed robot where nothing that is observed has to be at the goal."""
    relative = [source for source in trials.drawn.copies if source in trials.drawn.reaches]
    objects = {} if relative else _find_object_sources(trials)
    if not relative and not objects:
        yield Skipped(RULE.id, "no link or object is observed relative to the goal", applies=False)
        return
    at_goal = trials.at_goal
    if objects and at_goal.source is not None:
        yield from _judge_objects(trials, at_goal.source, objects)
        return
    if objects or not at_goal.reports_success or at_goal.source is not None:
        return
    for name in _find_links(trials):
        observed = f"observation[{relative[0][0]}]"
        message = f"is_success is true with {trials.drawn.name} at {name}, and not where {observed} is 0"
        yield RuleFinding(RULE, message, {"element": observed, "seed": FIRST_SEED, "value": name})
        return


def _find_links(trials: GoalTrials) -> list[str]:
    """Return the names of the links at which a goal is a success in every episode."""
    common: dict[str, int] = {}
    for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
        places = trials.find_links(seed)
        for name, place in places.items():
            common[name] = common.get(name, 0) + bool(trials.succeeds(seed, place))
    return [name for name, count in common.items() if count == EPISODES]


def _judge_objects(trials: GoalTrials, source: Source, objects: Mapping[Source, str]) -> Iterator[RuleFinding]:
    """Yield that a goal at a place of the observation is a success, and none at any object that is to be there."""
    if source in objects or any(trials.is_success_at(one) for one in objects):
        return
    (element, _), name = next(iter(objects.items()))
    message = f"is_success is true with {trials.drawn.name} where observation[{source[0]}] and what follows it are,"
    message += f" and false with it at {name}, which is observed relative to it (observation[{element}])"
    yield RuleFinding(RULE, message, {"element": f"observation[{element}]", "seed": FIRST_SEED, "value": name})


def _find_object_sources(trials: GoalTrials) -> dict[Source, str]:
    """Return the objects whose way to the goal is observed, or that are the achieved goal, by where that is."""
    candidates = [*trials.drawn.copies, *_find_achieved(trials)]
    names: dict[Source, set[str]] = {}
    for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
        episode = GoalEpisode(trials, seed, "repeated", PLACED_STEPS)
        places = find_objects(trials.instance.env, trials.instance.find_clients())
        objects = {name: place[trials.drawn.place.axes] for name, place in places.items()}
        for source in candidates:
            place = episode.read(source)
            near = {name for name, there in objects.items() if np.abs(there - place).max() < NEAR}
            names[source] = names.get(source, near) & near
    return {source: min(found) for source, found in names.items() if found}


def _find_achieved(trials: GoalTrials) -> Iterator[Source]:
    """Yield where the observation has the achieved goal."""
    element = 0
    for index in find_float_leaves(trials.instance.leaves):
        leaf = trials.instance.leaves[index]
        size = int(np.prod(leaf.shape))
        if leaf.path == ("achieved_goal",) and size == trials.drawn.place.size:
            yield element, 0
        element += size
