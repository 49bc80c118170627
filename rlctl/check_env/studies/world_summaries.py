"""What is worth telling of the episodes of a world: extremes with their place."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.studies.world_life import Life
from rlctl.check_env.studies.world_reading import Column, Pair
from rlctl.check_env.world_results import Excess, Fall, Penetration, TopSpeed

DEEP_STEPS = 3
"""Shorter than this a penetration is a blow that the solver has not answered yet [steps]."""
FAST_STEPS = 3
"""A speed counts that was reached or passed in so many steps of an episode."""
PART_OF_RANGE, LEAST_ANGLE, LEAST_LENGTH = 0.1, 0.05, 0.01
"""How far outside its limits a joint may be: part of the range, and at least so much [rad], [m]."""
MOST_TOLD = 5


def penetrations(lives: Sequence[Life]) -> list[Penetration]:
    """Return what was inside something else for several steps in a row, the deepest first, each pair once."""
    worst: dict[Pair, Penetration] = {}
    for life in lives:
        if life.moments and life.moments[0].actions != "extreme":
            for pair, found in _rows_of_deep(life):
                if pair not in worst or found.depth > worst[pair].depth:
                    worst[pair] = found
    return sorted(worst.values(), key=lambda each: -each.depth)[:MOST_TOLD]


def _rows_of_deep(life: Life) -> Iterator[tuple[Pair, Penetration]]:
    for pair in {pair for deep in life.deep for pair in deep}:
        row: list[int] = []
        longest: list[int] = []
        for i, deep in enumerate(life.deep):
            row = [*row, i] if pair in deep else []
            longest = row if len(row) > len(longest) else longest
        if len(longest) >= DEEP_STEPS:
            deepest = max(longest, key=lambda i: life.deep[i][pair][0])
            depth, limit = life.deep[deepest][pair]
            names = [life.link_name(link) for link in pair]
            yield (
                pair,
                Penetration(names, depth, limit, len(longest), life.moments[longest[0]].step, life.moments[deepest]),
            )


def excesses(lives: Sequence[Life]) -> list[Excess]:
    """Return the joints that were outside their limits by much, at their worst."""
    worst: dict[tuple[str, str], tuple[float, Excess]] = {}
    for life in lives:
        states = life.states
        for i, column in enumerate(life.world.columns):
            if column.kind == "joint position" and column.joint and column.joint.has_limits:
                size, found = _excess(life, column, states[:, i])
                key = (life.world.bodies[column.body].name, column.name)
                if found is not None and size > worst.get(key, (0.0,))[0]:
                    worst[key] = (size, found)
    ordered = sorted(worst.values(), key=lambda each: -each[0])
    return [found for _, found in ordered[:MOST_TOLD]]


def _excess(life: Life, column: Column, values: NDArray[np.float64]) -> tuple[float, Excess | None]:
    joint = column.joint
    assert joint is not None
    width = joint.high - joint.low
    allowed = max(PART_OF_RANGE * width, LEAST_ANGLE if joint.is_angle else LEAST_LENGTH)
    outside = np.maximum(joint.low - values, values - joint.high)
    outside = np.where(np.isfinite(outside), outside, 0.0)
    steps = int((outside > allowed).sum())
    if not steps:
        return 0.0, None
    row = int(outside.argmax())
    body = life.world.bodies[column.body].name
    place = life.moments[row]
    value = float(values[row])
    return float(outside[row] / width), Excess(
        body, joint.name, joint.is_angle, joint.low, joint.high, value, steps, place
    )


def speeds(lives: Sequence[Life]) -> list[TopSpeed]:
    """Return per body and joint the highest speed that lasted; of numbers that are not finite the first."""
    top: dict[tuple[str, str, str], TopSpeed] = {}
    for life in lives:
        for found in _speeds(life):
            key = (found.body, found.joint, found.kind)
            if key not in top or _size(found) > _size(top[key]):
                top[key] = found
    return list(top.values())


def _size(speed: TopSpeed) -> float:
    return speed.value if isinstance(speed.value, float) else math.inf


def _speeds(life: Life) -> Iterator[TopSpeed]:
    states = life.states
    for place, body in enumerate(life.world.bodies):
        numbers = [i for i, each in enumerate(life.world.columns) if each.body == place]
        wrong = np.argwhere(~np.isfinite(states[:, numbers]))
        if wrong.size:
            row, column = wrong[0].tolist()
            joint = life.world.columns[numbers[column]].joint
            text = str(states[row, numbers[column]])
            yield TopSpeed(body.name, joint.name if joint else "", "m/s", text, life.moments[row])
            continue
        linear = states[:, life.column(place, "linear velocity")]
        yield _lasting(life, body.name, "", "m/s", np.linalg.norm(linear, axis=1))
        angular = states[:, life.column(place, "angular velocity")]
        yield _lasting(life, body.name, "", "rad/s", np.linalg.norm(angular, axis=1))
        for column in life.column(place, "joint velocity"):
            joint = life.world.columns[column].joint
            assert joint is not None
            kind = "rad/s" if joint.is_angle else "m/s"
            yield _lasting(life, body.name, joint.name, kind, np.abs(states[:, column]))


def _lasting(life: Life, body: str, joint: str, kind: str, values: NDArray[np.float64]) -> TopSpeed:
    row = int(np.argsort(values)[-min(FAST_STEPS, len(values))])
    return TopSpeed(body, joint, kind, float(values[row]), life.moments[row])


def falls(lives: Sequence[Life]) -> list[Fall]:
    """Return how far each free body sank, with actions of zero, until it touched something."""
    return [
        fall
        for life in lives
        if life.moments and life.moments[0].actions == "zero"
        for place, body in enumerate(life.world.bodies)
        if body.is_free and (fall := _fall(life, place))
    ]


def _fall(life: Life, place: int) -> Fall | None:
    heights = np.nan_to_num(life.states[:, life.column(place, "position")[2]])
    body = life.world.bodies[place]
    for i, touching in enumerate(life.touching):
        if body.id in touching:
            return Fall(body.name, float(heights[0] - heights[i]), life.moments[0]) if i else None
    return None
