"""RL127: place and velocity in different frames."""

from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.experiment import RECORDING, judges_records
from rlctl.checking.experiments.attributes import AttributeLog, find_log_without_engine
from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.records import Built, Records
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.rules.rl124_velocity_turned_the_wrong_way import find_wrong_turns
from rlctl.checking.shared_frames import (
    IN_WORLD,
    Misfit,
    find_misfits,
    is_world_velocity,
    list_attribute_turns,
    list_world_turns,
    name_elements,
    name_observed,
    name_part,
    turn_level,
)
from rlctl.checking.step_times import estimate_step
from rlctl.checking.transitions import collect_transitions, find_unit_pairs

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


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in [*watched.observed, *watched.thrown]:
        names, parts = name_observed(watched.instance.env, one)
        angles = {scaled.column for scaled in one.scaled if scaled.value.is_angle}  # neither places nor velocities
        parts = [f"{part}[{i}]" if i in angles else part for i, part in enumerate(parts)]
        seconds = float(np.median(np.concatenate([np.diff(log.times) for log in one.logs])))
        for misfit in find_misfits(one.observed, parts, one.episodes, list_world_turns(one), seconds):
            yield _describe(misfit, *(name_part(names[part]) for part in misfit[:2]))
            return


@judges_records(RULE, *RECORDING, "worlds", "attributes")
def _judge_records(records: Records) -> Iterator[RuleFinding]:
    """Yield what a robot without an engine shows: by its attributes, or where its heading is observed."""
    log = find_log_without_engine(records)
    if log is None:
        return
    if any(find_wrong_turns(log)):
        return  # RL124 tells which velocity it is
    built, seconds = records.require_built(), estimate_step(log)
    if seconds is None:
        raise NotApplicable("it is not known how long a step takes")
    found = _find_in_attributes(log, built, seconds) or _find_in_observations(records, built, seconds)
    if found is not None:
        misfit, names = found
        yield _describe(misfit, *(name_part(names[part]) for part in misfit[:2]))


def _find_in_attributes(log: AttributeLog, built: Built, seconds: float) -> tuple[Misfit, Sequence[str]] | None:
    names, parts = name_elements(built)
    for misfit in find_misfits(log.observed, parts, log.episodes, list_attribute_turns(log), seconds):
        if misfit.power != IN_WORLD or is_world_velocity(log, log.observed[:, misfit.velocity]):
            return misfit, names
    return None


def _find_in_observations(records: Records, built: Built, seconds: float) -> tuple[Misfit, Sequence[str]] | None:
    """Return what is turned twice by a heading of which the cosine and the sine are observed; nothing else, as nobody
    knows in which direction a heading is counted."""
    try:
        steps = collect_transitions(records, with_constants=True)
    except NotJudged:
        return None
    names, parts = name_elements(built)
    turns = [
        turn_level(f"the angle of ({names[i]}, {names[j]})", np.arctan2(steps.before[:, j], steps.before[:, i]), (i, j))
        for one, two in find_unit_pairs(steps.before)
        for i, j in ((one, two), (two, one))
    ]
    misfits = find_misfits(steps.before, parts, steps.episodes, turns, seconds, TWICE)
    return next(((misfit, names) for misfit in misfits), None)


def _describe(misfit: Misfit, place: str, velocity: str) -> RuleFinding:
    turn = misfit.turn.name
    if misfit.power == IN_WORLD:
        what = f"{velocity} is in the world's frame, and {place} is in a frame that is turned by {turn}: the length of"
        message = f"{what} {place} changes by the velocity only if that is turned back"
    else:
        what = f"{place} or {velocity} is turned by {turn} in the wrong direction: the length of {place} changes by the"
        message = f"{what} velocity only if that is turned by twice the angle"
    return RuleFinding(RULE, message, {"element": velocity, "value": place}, same=("RL124", "RL125"))
