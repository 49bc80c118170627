"""Plays one episode of an environment in MuJoCo again and again, with something done around its calls of MuJoCo."""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.instance import Instance
from rlctl.checking.mujoco_calls import MujocoCalls
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import list_names
from rlctl.checking.values import ArrayNames, flatten, list_parts, name_numbers
from rlctl.checking.worlds import Array
from rlctl.environments.simulations import find_mujoco

STEPS = 25


@dataclasses.dataclass(frozen=True)
class Look:
    """What a call of reset or step returned, and where the simulation was."""

    observation: Array
    parts: ArrayNames
    reward: float
    qpos: Array


def play(
    instance: Instance,
    calls: MujocoCalls,
    steps: int = STEPS,
    seed: int = FIRST_SEED,
    after_look: Callable[[], None] = lambda: None,
    **hooks: Any,
) -> list[Look]:
    """Play an episode with some functions of `calls` replaced; `after_look` is called after reset and each step."""
    quiet = {field.name: field.default for field in dataclasses.fields(MujocoCalls) if field.name.startswith("after")}
    for name, function in (quiet | hooks).items():
        setattr(calls, name, function)
    looks = []
    try:
        for moment in EpisodePlayer(instance, seed, max_steps=steps):
            simulation = find_mujoco(instance.env)
            qpos = simulation[1].qpos.copy() if simulation else np.zeros(0)
            observation = np.nan_to_num(flatten(moment.observation).astype(np.float64))
            looks.append(Look(observation, list(list_parts(moment.observation)), _read_reward(moment.reward), qpos))
            after_look()
    finally:
        for name, function in quiet.items():
            setattr(calls, name, function)
        calls.as_stepped = contextlib.nullcontext
    return looks


def _read_reward(reward: Any) -> float:
    try:
        return float(np.nan_to_num(float(reward)))
    except (TypeError, ValueError):
        return 0.0


def pair_rows(plain: Sequence[Look], changed: Sequence[Look]) -> tuple[Array, Array] | None:
    """Return observations and rewards of both, shape (n, m + 1), as long as the simulation is the same."""
    pairs = []
    for one, two in zip(plain, changed, strict=False):
        if not np.array_equal(one.qpos, two.qpos) or one.observation.shape != two.observation.shape:
            break
        pairs.append([np.append(look.observation, look.reward) for look in (one, two)])
    if not pairs or len({row.shape for pair in pairs for row in pair}) > 1:
        return None
    first, second = np.array(pairs).transpose(1, 0, 2)
    return first, second


def are_equal(plain: Sequence[Look], again: Sequence[Look]) -> bool:
    """Say whether an episode was the same when it was played again."""
    pair = pair_rows(plain, again)
    return pair is not None and len(pair[0]) == len(plain) and np.array_equal(*pair)


def name_columns(columns: Sequence[int], look: Look) -> str:
    """Name columns of `pair_rows` of such looks."""
    size = look.observation.size
    names = [name_numbers(look.parts, column) for column in columns if column < size]
    return list_names([*names, *(["the reward"] if size in columns else [])])
