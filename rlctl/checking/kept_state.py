"""State that a reset does not set back: of the environment's objects, of MuJoCo, and of PyBullet's bodies."""

import contextlib
import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import attitudes
from rlctl.checking.bullet_worlds import read_poses, read_states, read_world
from rlctl.checking.instance import Instance
from rlctl.checking.mujoco_worlds import read_kept_fields
from rlctl.checking.rule import list_names
from rlctl.checking.values import Attribute, find_unequal, read_attributes
from rlctl.checking.worlds import ORIENTATION
from rlctl.environments.bullet_clients import ClientCalls
from rlctl.environments.leaves import Leaf, pick

MUJOCO, PYBULLET = "MuJoCo", "PyBullet"
MOST_OBSERVED = 1_000  # larger arrays of an observation are images
SAME = 1e-6  # relative; the last bits of float32
MOST_NAMES = 5
ATTITUDE = "orientation of"  # a base; its numbers are angles and functions of them
Observed = Mapping[int, NDArray[np.float64]]
"""The numbers of an observation, flat, by the place of their array."""


@dataclasses.dataclass(frozen=True)
class KeptState:
    """Numbers that the steps of an episode change, and that the next reset does not set back."""

    name: str  # `self.position`, `data.qvel`, `joint speeds of arm`
    engine: str  # that holds it: `MUJOCO`, `PYBULLET`, or empty
    observed: Mapping[tuple[int, int], str]
    """What an observation shows of it, `data.qvel[1]`, by the place of the array and the flat index in it."""

    @property
    def is_simulated(self) -> bool:
        """Whether MuJoCo's mj_resetData sets it back."""
        return self.name.startswith("data.")


@dataclasses.dataclass(frozen=True)
class StateAfterReset:
    """What an instance holds and observes directly after a reset."""

    parts: Mapping[str, Attribute]
    engines: Mapping[str, str]  # by the name of a part, of those that an engine holds
    observed: Observed


def read_state(instance: Instance, observation: Any) -> StateAfterReset:
    """Read the attributes of an instance and the state of its engine; no code of the environment runs."""
    env = instance.env
    fields, bodies = read_kept_fields(env), _read_bodies(instance.find_clients())
    engines = dict.fromkeys(fields, MUJOCO) | dict.fromkeys(bodies, PYBULLET)
    observed = dict(_read_observed(instance.leaves, observation))
    return StateAfterReset(read_attributes(env) | fields | bodies, engines, observed)


def find_kept(untouched: StateAfterReset, clean: StateAfterReset, dirty: StateAfterReset) -> list[KeptState]:
    """Return what differs between resets with equal seeds, the last of which followed some steps.

    What also differs between the first two, such as a clock, is left out unless there is nothing else.
    """
    every_time = find_unequal(untouched.parts, clean.parts)
    names = find_unequal(clean.parts, dirty.parts)
    # A property of the model that every reset changes is no clock: it decides how everything moves.
    names = [name for name in names if name not in every_time or _is_property(name)] or names
    return [KeptState(name, dirty.engines.get(name, ""), _find_observed(name, clean, dirty)) for name in names]


def describe_kept(kept: Sequence[KeptState], element: tuple[int, int] | None, element_name: str) -> tuple[str, str]:
    """Return which state a reset keeps, for a message, and what sets it back.

    What the element shows that differs comes first, then what others show. The element is given as in
    `KeptState.observed`; None if the difference came later than at the reset.
    """
    ranked = sorted(
        kept, key=lambda one: (element not in one.observed, not one.observed, not _is_property(one.name), one.name)
    )
    if not ranked:
        return "", "Set back in reset: every attribute that step changes, and the whole simulation."
    names = list_names([one.name for one in ranked], MOST_NAMES)
    shown = ranked[0].observed.get(element) if element is not None else None
    source = f"; {element_name} is {shown}" if shown is not None else ""
    return f" ({names}){source}", f"Set back in reset: {names}.{_name_calls(ranked)}"


def _is_property(name: str) -> bool:
    return name.startswith("model.")


def _name_calls(kept: Sequence[KeptState]) -> str:
    calls = ""
    if any(one.is_simulated for one in kept):
        calls += " mujoco.mj_resetData(model, data) sets back all of data."
    if any(one.engine == PYBULLET for one in kept):
        calls += " resetJointState, resetBasePositionAndOrientation and resetBaseVelocity set back bodies of PyBullet."
    return calls


def _read_bodies(clients: Iterable[int]) -> dict[str, Attribute]:
    """Return what PyBullet clients simulate: positions and velocities of bases and joints."""
    parts: dict[str, NDArray[np.float64]] = {}
    for client in clients:
        with contextlib.suppress(ClientCalls(client).error):  # a body that was removed meanwhile
            world = read_world(client)
            poses = read_poses(world)
            for body, state in zip(world.bodies, read_states(world), strict=True):
                if body.is_free:
                    parts.setdefault(f"position of {body.name}", state[:3])
                    angles = attitudes.compute_attitudes(poses[body.id, -1][None, ORIENTATION])[0]
                    parts.setdefault(f"{ATTITUDE} {body.name}", angles)
                    parts.setdefault(f"velocity of {body.name}", state[3:6])
                    parts.setdefault(f"angular velocity of {body.name}", state[6:9])
                if body.joints:
                    positions, speeds = np.split(state[9:], 2)
                    parts.setdefault(f"joint positions of {body.name}", positions)
                    parts.setdefault(f"joint speeds of {body.name}", speeds)
    return {name: Attribute(name, None, name, value) for name, value in parts.items()}


def _read_observed(leaves: Sequence[Leaf], observation: Any) -> Iterator[tuple[int, NDArray[np.float64]]]:
    for index, leaf in enumerate(leaves):
        if not leaf.supported or np.prod(leaf.shape) > MOST_OBSERVED:
            continue
        with contextlib.suppress(LookupError, TypeError, ValueError):  # RL101 reports what does not fit the space
            numbers = np.asarray(pick(observation, leaf.path), np.float64)
            if numbers.shape == leaf.shape:
                yield index, numbers.ravel()


def _find_observed(name: str, clean: StateAfterReset, dirty: StateAfterReset) -> dict[tuple[int, int], str]:
    """Return the elements of the observation that equal a number of the state after both resets, which differs."""
    found: dict[tuple[int, int], str] = {}
    one, two = clean.parts[name], dirty.parts[name]
    for number in np.flatnonzero(one.numbers != two.numbers).tolist():
        for leaf in clean.observed.keys() & dirty.observed.keys():
            is_same = _equals(clean.observed[leaf], one.numbers[number])
            is_same &= _equals(dirty.observed[leaf], two.numbers[number])
            for index in np.flatnonzero(is_same).tolist():
                found.setdefault((leaf, index), _name_number(two, number))
    return found


def _equals(observed: NDArray[np.float64], number: float) -> NDArray[np.bool_]:
    return np.abs(observed - number) <= SAME * np.abs(number)


def _name_number(attribute: Attribute, number: int) -> str:
    shape = np.shape(attribute.value)
    if not shape or attribute.name.startswith(ATTITUDE):
        return attribute.name
    return f"{attribute.name}[{', '.join(str(int(i)) for i in np.unravel_index(number, shape))}]"
