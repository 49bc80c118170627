"""Plays variants of a deployment in the worlds of another one, all at once: only what is read and sent differs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.policy.actor import Actor, Array, Rows
from rlctl.task.deployment import RELATIVE, Deployment


@dataclasses.dataclass(frozen=True, eq=False)
class ElementMap:
    """Value k is `factor[k] * given[source[k]] + offset[k]`."""

    source: NDArray[np.int64]
    factor: NDArray[np.float64]
    offset: NDArray[np.float64]


def map_observation(world: Deployment, variant: Deployment, network: Deployment) -> ElementMap:
    """Return how an observation of `world`'s task becomes the input with which a network acts as `variant` says.

    The network is that of a policy file that was imported with the deployment `network`.
    """
    source, factor, offset = _measure(world, variant)
    own_columns, own_factors = network.find_columns()
    columns, factors = variant.find_columns()
    safe = np.where(own_factors == 0, 1.0, own_factors)
    ratio = np.where(own_factors == 0, 0.0, factors / safe)
    mapped = ElementMap(np.zeros_like(source), np.zeros_like(factor), np.zeros_like(offset))
    mapped.source[own_columns] = source[columns]
    mapped.factor[own_columns] = ratio * factor[columns]
    mapped.offset[own_columns] = ratio * offset[columns]
    return mapped


def _measure(own: Deployment, variant: Deployment) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return the elements of the variant's observation, in rlctl's layout, in terms of those of the own one."""
    layout, size = variant.layout, variant.layout.size
    source, factor, offset = np.zeros(size, np.int64), np.ones(size), np.zeros(size)
    places = {part.name: part for part in own.layout.parts}
    joints = np.array([own.joints.index(name) for name in variant.joints])
    own_default, default = np.array(own.default_positions)[joints], np.array(variant.default_positions)
    own_scale, scale = np.array(own.action_scale)[joints], np.array(variant.action_scale)
    is_wheel = np.isin(variant.joints, own.wheels)
    relative = {part.kind for part in variant.measured_parts if part.kind in RELATIVE and part.relative}
    for part in layout.parts:
        elements, factors, offsets = np.arange(part.size), np.ones(part.size), np.zeros(part.size)
        if part.name in (*RELATIVE, "joint_velocities", "last_action"):
            elements = joints
        elif part.name == "motion":
            elements = np.concatenate([joints, len(joints) + joints])
        if part.name in relative:
            offsets = own_default - default
        elif part.name == "last_action":
            factors = own_scale / scale
            offsets = np.where(is_wheel, 0.0, (own_default - default) / scale)
        for frame in range(part.frames):
            at = slice(part.start + frame * part.size, part.start + (frame + 1) * part.size)
            source[at] = places[part.name].start + frame * part.size + elements
            factor[at], offset[at] = factors, offsets
    return source, factor, offset


def map_action(own: Deployment, variant: Deployment) -> ElementMap:
    """Return how an action of the variant becomes that of `own`'s task, with the same targets of the joints."""
    places = np.array([variant.joints.index(name) for name in own.joints])
    scale, own_scale = np.array(variant.action_scale)[places], np.array(own.action_scale)
    shift = np.array(variant.default_positions)[places] - np.array(own.default_positions)
    shift[np.isin(own.joints, own.wheels)] = 0.0
    return ElementMap(places, scale / own_scale, shift / own_scale)


class MappedActor(Actor):
    """A policy that acts in each row as a variant of its deployment says."""

    def __init__(self, actor: Actor, network: Deployment, world: Deployment, variants: Sequence[Deployment]) -> None:
        """`actor` was imported with `network` and plays in `world`'s task; `variants` has a deployment per row."""
        self._actor = actor
        observed = [map_observation(world, variant, network) for variant in variants]
        acted = [map_action(world, variant) for variant in variants]
        self._observed, self._acted = _stack(observed), _stack(acted)

    def begin(self, rows: Rows) -> None:
        """Begin episodes in some rows."""
        self._actor.begin(rows)

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the actions for the task."""
        seen = _apply(self._observed, observations, rows).astype(np.float32)
        actions = self._actor.act(seen, rows)[1]
        sent = _apply(self._acted, actions, rows).astype(np.float32)
        return sent, sent


def _stack(maps: Sequence[ElementMap]) -> ElementMap:
    return ElementMap(
        *(np.stack([getattr(one, field.name) for one in maps]) for field in dataclasses.fields(ElementMap))
    )


def _apply(stacked: ElementMap, values: Any, rows: Rows) -> NDArray[np.float64]:
    index = rows.index
    taken = np.take_along_axis(np.asarray(values, np.float64), stacked.source[index], axis=1)
    return np.asarray(stacked.factor[index] * taken + stacked.offset[index])
