"""RL128: command and velocity in different frames."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import find_log_without_engine
from rlctl.checking.experiments.worlds import ObservedWorld, WatchedWorlds, judges_worlds
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.shared_frames import (
    IN_WORLD,
    MOST_ELEMENTS,
    MOST_TURNS,
    RIGHT,
    WRONG,
    Turn,
    is_world_velocity,
    list_attribute_turns,
    list_world_turns,
    name_elements,
    name_observed,
    name_part,
)
from rlctl.checking.worlds import Array

RULE = Rule(
    "RL128",
    "command and velocity in different frames",
    Severity.WARNING,
    meaning="""
        The reward, or a term of it, falls with the difference of the commanded velocity and the velocity in the frame
        of the robot, and the observation has the velocity in the axes of the world beside the command, or turned by
        the heading in the wrong direction. What the policy compares is not what is paid, and on the real robot the
        velocity is estimated in its own frame.
    """,
    fix="""
        Observe the velocity in the frame of the command, R.T @ v; by a yaw x' = cos(yaw) x + sin(yaw) y and y' =
        cos(yaw) y - sin(yaw) x.
    """,
)

SIZE = 2  # of a command and of a velocity
FALLS, OTHERWISE = 0.995, 0.97
"""Rank correlation of what is paid and of the difference that it falls with, at least; and of any other, at most."""
KEPT = 0.9  # part of the steps in which a command stays
FEWEST_STEPS, FEWEST_COMMANDS = 60, 3
LEAST_CHANGE = 1e-6  # of what is paid, standard deviation


class _Steps(NamedTuple):
    """Steps of some episodes."""

    before: Array  # Observations. Shape (steps, elements)
    after: Array
    turns: Sequence[Turn]  # after each step
    paid: Mapping[str, Array]  # Shape (steps,) each; NaN where it is not known


class _Misfit(NamedTuple):
    paid: str
    command: slice
    velocity: slice
    turn: Turn
    power: int


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in watched.observed:
        names, parts = name_observed(watched.instance.env, one)
        for misfit in _find_misfits(_read_steps(one), parts):
            yield _describe(misfit, *(name_part(names[part]) for part in misfit[1:3]))
            return


def _read_steps(one: ObservedWorld) -> _Steps:
    after = 1 + np.flatnonzero(np.diff(one.episodes) == 0)
    turns = [turn.select(after) for turn in list_world_turns(one)]
    told = [numbers for log in one.logs for numbers in log.told]
    rewards = np.array([reward for log in one.logs for reward in log.rewards])[after]
    names = sorted({name for numbers in told for name in numbers})
    paid = {f"info[{n!r}]": np.array([told[i].get(n, np.nan) for i in after.tolist()]) for n in names}
    return _Steps(one.observed[after - 1], one.observed[after], turns, {**paid, "the reward": rewards})


@judges_records(RULE, "worlds", "attributes")
def _judge_attributes(records: Records) -> Iterator[RuleFinding]:
    log = find_log_without_engine(records)
    if log is None:
        return
    names, parts = name_elements(records.require_built())
    after = np.flatnonzero(log.is_step)
    turns = [turn.select(after) for turn in list_attribute_turns(log)]
    paid = {f"info[{name!r}]": values[after] for name, values in log.infos.items()}
    steps = _Steps(log.observed[after - 1], log.observed[after], turns, {**paid, "the reward": log.rewards[after]})
    for misfit in _find_misfits(steps, parts):
        if misfit.power != IN_WORLD or is_world_velocity(log, log.observed[:, misfit.velocity]):
            yield _describe(misfit, *(name_part(names[part]) for part in misfit[1:3]))
            return


def _find_misfits(steps: _Steps, parts: Sequence[object]) -> Iterator[_Misfit]:
    """Yield what falls with the difference of a command and of a velocity that is turned, and of no other one."""
    count = min(MOST_ELEMENTS, steps.after.shape[1])
    firsts = [i for i in range(count - SIZE + 1) if len(set(parts[i : i + SIZE])) == 1]
    turns = [turn for turn in steps.turns if turn.is_turned][:MOST_TURNS]
    commands = [first for first in firsts if _is_command(steps, first)]
    moving = [first for first in firsts if _moves(steps, first)]
    if not turns or len(steps.after) < FEWEST_STEPS:
        return
    for command in commands:
        kept = (steps.before[:, command : command + SIZE] == steps.after[:, command : command + SIZE]).all(axis=1)
        wanted = steps.after[kept, command : command + SIZE]
        velocities = [first for first in moving if abs(first - command) >= SIZE]
        differences, ways = _list_differences(steps, turns, kept, wanted, velocities)
        for name, values in steps.paid.items():
            rows = np.isfinite(values[kept])
            if rows.sum() < FEWEST_STEPS or values[kept][rows].std() < LEAST_CHANGE or not ways:
                continue
            falls = _correlate_ranks(values[kept][rows], differences[rows])
            right = max((fall for fall, way in zip(falls, ways, strict=True) if way[2] in RIGHT), default=0.0)
            best = int(np.argmax(falls))
            velocity, number, power = ways[best]
            if power in WRONG and falls[best] > FALLS and right < OTHERWISE:
                slices = slice(command, command + SIZE), slice(velocity, velocity + SIZE)
                yield _Misfit(name, *slices, turns[number], power)


def _is_command(steps: _Steps, first: int) -> bool:
    before, after = (rows[:, first : first + SIZE] for rows in (steps.before, steps.after))
    is_drawn = min(len(np.unique(column)) for column in after.T) >= FEWEST_COMMANDS
    return is_drawn and bool((before == after).all(axis=1).mean() >= KEPT)


def _moves(steps: _Steps, first: int) -> bool:
    before, after = (rows[:, first : first + SIZE] for rows in (steps.before, steps.after))
    return bool((before != after).mean(axis=0).min() > 1 - KEPT)


def _list_differences(
    steps: _Steps, turns: Sequence[Turn], kept: NDArray[np.bool_], wanted: Array, velocities: Sequence[int]
) -> tuple[Array, list[tuple[int, int, int]]]:
    """Return how far velocities are from a command, shape (steps, ways), and of each which velocity, turn and power it
    is."""
    columns, ways = [np.zeros((len(wanted), 0))], []
    for number, turn in enumerate(turns):
        matrices = turn.reduce(SIZE)[kept]
        for power in (*RIGHT, *WRONG):
            turned = np.linalg.matrix_power(matrices, power)
            for velocity in velocities:
                vectors = steps.after[kept, velocity : velocity + SIZE]
                difference = np.einsum("nij,nj->ni", turned, vectors) - wanted
                columns.append(np.linalg.norm(difference, axis=1)[:, None])
                ways.append((velocity, number, power))
    return np.hstack(columns), ways


def _correlate_ranks(values: Array, columns: Array) -> Array:
    """Return how far values fall, or costs rise, as columns rise: their rank correlations. Shapes (n,) and (n, k)."""
    ranks = np.argsort(np.argsort(np.column_stack([values, columns]), axis=0), axis=0).astype(float)
    ranks -= ranks.mean(axis=0)
    norms = np.linalg.norm(ranks, axis=0)
    return np.abs(ranks[:, 0] @ ranks[:, 1:]) / np.maximum(norms[0] * norms[1:], 1e-12)


def _describe(misfit: _Misfit, command: str, velocity: str) -> RuleFinding:
    turn = misfit.turn.name
    where = (
        "the axes of the world" if misfit.power == IN_WORLD else f"no frame of the robot: {turn} turns it the wrong way"
    )
    message = (
        f"{misfit.paid} falls with the difference of the command {command} and of {velocity} turned by {turn}, and"
    )
    message += f" {velocity} is in {where}"
    return RuleFinding(RULE, message, {"element": velocity, "value": command})
