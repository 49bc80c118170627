"""RL127: place and velocity in different frames."""

from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking import attitudes
from rlctl.checking.body_frames import list_turns_of
from rlctl.checking.experiment import RECORDING, judges_records
from rlctl.checking.experiments.attributes import AttributeLog
from rlctl.checking.experiments.worlds import ObservedWorld, WatchedWorlds, judges_worlds
from rlctl.checking.records import Built, Records
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.rules.rl124_velocity_turned_the_wrong_way import find_wrong_turns
from rlctl.checking.shared_frames import Misfit, Turn, find_misfits, turn_level
from rlctl.checking.step_times import estimate_step, find_rates
from rlctl.checking.transitions import collect_transitions, find_float_leaves, find_unit_pairs
from rlctl.checking.worlds import ORIENTATION, Array

RULE = Rule(
    "RL127",
    "place and velocity in different frames",
    Severity.WARNING,
    meaning="""
        The observation has the way to something and a velocity, in two frames that do not belong together. A way gets
        shorter by the velocity along it, if both are in one frame, or if the way is in the world's and the velocity in
        that of the body. Here it does so only with the velocity turned back by the heading, or turned by twice the
        heading: the velocity is in the world's frame and the way in that of the robot, or one of both was turned in
        the wrong direction.
    """,
    fix="""
        Turn both by the same inverse rotation, R.T @ v; by a yaw x' = cos(yaw) x + sin(yaw) y and y' = cos(yaw) y -
        sin(yaw) x.
    """,
)

TWICE = (2, -2)
IN_WORLD = -1
SAME_VELOCITY = 0.95  # correlation of what is observed with a velocity in the world, with noise
EQUAL = 1e-3  # elements of rotations that are one


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in [*watched.observed, *watched.thrown]:
        sizes = [len(log.observed) for log in one.logs]
        episodes = np.repeat(np.arange(len(sizes)), sizes)
        parts = [number for number, (_, size) in enumerate(one.logs[0].parts) for _ in range(size)]
        seconds = float(np.median(np.concatenate([np.diff(log.times) for log in one.logs])))
        for misfit in find_misfits(one.observed, parts, episodes, _list_turns(one), seconds):
            names = [_name([one.name_element(i) for i in range(part.start, part.stop)]) for part in misfit[:2]]
            yield _describe(misfit, *names)
            return


def _list_turns(one: ObservedWorld) -> list[Turn]:
    """Return how the bodies and links of a world are turned, each orientation once."""
    world, turns = one.logs[0].world, list[Turn]()
    for link in one.logs[0].poses[0]:
        if not all(link in poses for log in one.logs for poses in log.poses):
            continue
        quaternions = np.array([poses[link][ORIENTATION] for log in one.logs for poses in log.poses])
        turn = Turn(f"the orientation of {world.link_name(link)}", attitudes.compute_matrices(quaternions))
        if turn.is_turned and all(np.abs(turn.matrices - other.matrices).max() > EQUAL for other in turns):
            turns.append(turn)
    return turns


@judges_records(RULE, *RECORDING, "worlds", "attributes")
def _judge_records(records: Records) -> Iterator[RuleFinding]:
    """Yield what a robot without an engine shows: by its attributes, or where its heading is observed."""
    log: AttributeLog | None = records.facts.get("attributes")
    if log is None or np.isfinite(log.physics_s):
        return  # the engine tells more
    if any(find_wrong_turns(log)):
        return  # RL124 tells which velocity it is
    built, seconds = records.require_built(), estimate_step(log)
    if seconds is None:
        raise NotApplicable("it is not known how long a step takes")
    found = _find_in_attributes(log, built, seconds) or _find_in_observations(records, built, seconds)
    if found is not None:
        misfit, names = found
        yield _describe(misfit, *(_name(names[part]) for part in misfit[:2]))


def _find_in_attributes(log: AttributeLog, built: Built, seconds: float) -> tuple[Misfit, Sequence[str]] | None:
    names, parts = _name_elements(built)
    turns = [Turn(name, matrices) for name, matrices in list_turns_of(log.names, log.values)]
    for misfit in find_misfits(log.observed, parts, log.episodes, turns, seconds):
        if misfit.power != IN_WORLD or _is_world_velocity(log, log.observed[:, misfit.velocity]):
            return misfit, names
    return None


def _is_world_velocity(log: AttributeLog, vectors: Array) -> bool:
    """Say whether what is observed is that by which attributes change."""
    rates = {rate for _, rate, _ in find_rates(log, log.values)}
    columns = [log.values[:, rate] for rate in sorted(rates)]
    level = vectors.T[:2]  # which a heading turns
    return all(any(_correlate(vector, column) > SAME_VELOCITY for column in columns) for vector in level)


def _correlate(one: Array, two: Array) -> float:
    return float(np.corrcoef(one, two)[0, 1]) if one.std() > 0 and two.std() > 0 else 0.0


def _find_in_observations(records: Records, built: Built, seconds: float) -> tuple[Misfit, Sequence[str]] | None:
    """Return what is turned twice by a heading of which the cosine and the sine are observed; nothing else, as nobody
    knows in which direction a heading is counted."""
    try:
        steps = collect_transitions(records, with_constants=True)
    except NotJudged:
        return None
    names, parts = _name_elements(built)
    turns = [
        turn_level(f"the angle of ({names[i]}, {names[j]})", np.arctan2(steps.before[:, j], steps.before[:, i]), (i, j))
        for one, two in find_unit_pairs(steps.before)
        for i, j in ((one, two), (two, one))
    ]
    misfits = find_misfits(steps.before, parts, steps.episodes, turns, seconds, TWICE)
    return next(((misfit, names) for misfit in misfits), None)


def _name_elements(built: Built) -> tuple[list[str], list[int]]:
    """Return the names of the elements that rules read, and the array that each belongs to."""
    leaves = find_float_leaves(built.leaves)
    places = [(leaf, i) for leaf in leaves for i in range(int(np.prod(built.leaves[leaf].shape)))]
    return [built.element(leaf, i) for leaf, i in places], [leaf for leaf, _ in places]


def _name(names: Sequence[str]) -> str:
    return f"({names[0]} to {names[-1]})"


def _describe(misfit: Misfit, place: str, velocity: str) -> RuleFinding:
    turn = misfit.turn.name
    if misfit.power == IN_WORLD:
        what = f"{velocity} is in the world's frame, and {place} is in a frame that is turned by {turn}: the length of"
        message = f"{what} {place} changes by the velocity only if that is turned back"
    else:
        what = f"{place} or {velocity} is turned by {turn} in the wrong direction: the length of {place} changes by the"
        message = f"{what} velocity only if that is turned by twice the angle"
    return RuleFinding(RULE, message, {"element": velocity, "value": place})
