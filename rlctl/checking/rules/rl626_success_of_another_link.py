"""RL626: success of another link."""

from collections.abc import Iterator, Mapping

import numpy as np

from rlctl.checking.drawn_goals import Numbers, Source
from rlctl.checking.exchanged_objects import ObjectReader
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.goals import NEAR, judges_goals
from rlctl.checking.goal_episodes import PLACED_STEPS, GoalEpisode, GoalTrials
from rlctl.checking.goal_places import find_two_places
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
        object: its way to the goal is observed, or it is the achieved_goal, and success is where the hand is; or
        what is observed as its way is not 0 where it is at the goal, as with the goal in the world and the object
        in the robot's frame. Or the source compares the goal with two places that are always the same way apart: one
        of them is in another frame, or another point of the same body; or it compares the goal with the hand, pays the
        hand for reaching an object, and computes the way of this object to the goal elsewhere.
    """,
    fix="Use the same link, and the same point of it, in the observation, in the reward and for success.",
)

EPISODES = 3
MOVED, SAME_WAY = 0.02, 0.1  # how far an object is shifted [m], and the part by which what is observed may differ


@judges_expressions(RULE, decides=False)
def _find_places_apart(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    for one, other in find_two_places(noted):
        apart = [float(number) for number in np.round(one.values[0] - other.values[0], 4) + 0.0]
        message = f"{one.whole.text} and {other.whole.text} (line {other.whole.where[1]}) compare {one.goal} with two"
        message += f" places that are always {apart} apart, although both move"
        yield RuleFinding(RULE, message, {"element": one.name, "value": apart}, where=one.whole.where)
    for found in ObjectReader(noted).find():
        message = f"success compares {found.goal} with {found.hand}: the reward pays the way from {found.hand} to"
        message += f" {found.thing}, and the source also computes that of {found.thing} to {found.goal}"
        yield RuleFinding(RULE, message, {"element": found.hand}, where=noted.reward.locate(found.place))
        return


@judges_goals(RULE)
def _find_other_link(trials: GoalTrials) -> Iterator[ChildMessage]:
    """Put the goal at each link of a fixed robot where nothing that is observed has to be at the goal."""
    if not trials.drawn.place.is_place:
        yield Skipped(RULE.id, "the goal is no place", applies=False)
        return
    relative = [source for source in trials.drawn.copies if source in trials.drawn.reaches]
    objects = {} if relative else _find_object_sources(trials)
    at_goal = trials.at_goal
    if objects and at_goal.source is not None:
        yield from _judge_objects(trials, at_goal.source, objects)
        return
    ways = [*relative, *_find_ways(trials)]
    if not ways:
        yield Skipped(RULE.id, "no link or object is observed relative to the goal", applies=False)
        return
    if objects or not at_goal.reports_success or at_goal.source is not None:
        return
    for name in [*(_find_links(trials) if relative else []), *_find_places(trials, ways[0])]:
        observed = trials.name_elements(ways[0][0])
        message = f"is_success is true with {trials.drawn.name} at {name}, and not where {observed}"
        message += f" and what follows it are 0, which is {trials.drawn.name} minus another place"
        yield RuleFinding(RULE, message, {"element": observed, "seed": FIRST_SEED, "value": name})
        return


def _find_ways(trials: GoalTrials) -> list[Source]:
    """Return where the observation has the way to the goal, its difference to something, turned or not."""
    episode = GoalEpisode(trials, FIRST_SEED, "repeated", PLACED_STEPS)
    size = episode.goal.size
    is_way = {
        source: not np.allclose(source[1] * episode.observed[source[0] :][:size], episode.goal, atol=NEAR)
        for source in trials.drawn.copies
    }
    return [*trials.drawn.turned, *(source for source in trials.drawn.copies if is_way[source])]


def _find_places(trials: GoalTrials, way: Source) -> list[str]:
    """Return the names of objects at whose places a goal is a success in every episode, and whose shift changes what is
    observed as much: what is observed is to be the way to them."""
    common: dict[str, int] = {}
    for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
        for name in find_objects(trials.instance.env, trials.instance.find_clients()):
            common[name] = common.get(name, 0) + _is_there(trials, way, name, seed)
    return [name for name, count in common.items() if count == EPISODES]


def _is_there(trials: GoalTrials, way: Source, name: str, seed: int) -> bool:
    for actions in ("repeated", "zero"):
        episode = GoalEpisode(trials, seed, actions, PLACED_STEPS)
        place = _read_object(trials, name)
        if episode.has_ended or episode.has_succeeded or place is None:
            continue
        if trials.succeeds(seed, place, None, actions):
            parts = []
            for shift in (0.0, MOVED):
                episode = GoalEpisode(trials, seed, actions, PLACED_STEPS)
                objects = find_objects(trials.instance.env, trials.instance.find_clients())
                objects[name].shift(np.array([shift]))
                episode.play([None])
                parts.append(episode.observed[way[0] :][: place.size])
            return bool(abs(np.linalg.norm(parts[1] - parts[0]) - MOVED) < SAME_WAY * MOVED)
    return False


def _read_object(trials: GoalTrials, name: str) -> Numbers | None:
    objects = find_objects(trials.instance.env, trials.instance.find_clients())
    return objects[name].read()[trials.drawn.place.axes] if name in objects else None


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
    place, way = trials.name_elements(source[0]), trials.name_elements(element)
    message = f"is_success is true with {trials.drawn.name} where {place} and what follows it are,"
    message += f" and false with it at {name}, which is observed relative to it ({way})"
    yield RuleFinding(RULE, message, {"element": way, "seed": FIRST_SEED, "value": name})


def _find_object_sources(trials: GoalTrials) -> dict[Source, str]:
    """Return the objects whose way to the goal is observed, or that are the achieved goal, by where that is."""
    candidates = [*trials.drawn.copies, *_find_achieved(trials)]
    names: dict[Source, set[str]] = {}
    for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
        episode = GoalEpisode(trials, seed, "repeated", PLACED_STEPS)
        places = find_objects(trials.instance.env, trials.instance.find_clients())
        objects = {name: one.read()[trials.drawn.place.axes] for name, one in places.items()}
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
