"""Which elements of an environment's observations are older values of histories and stacked frames."""

import math
from typing import Any

import numpy as np
from gymnasium import spaces

from rlctl.play.workers import Workers
from rlctl.training.rollouts import to_network_layout
from rlctl.training.stacked_replay import Stacking


def find_stacking(workers: Workers, space: spaces.Space[Any]) -> Stacking | None:
    """Return how the observations of a network are stacked; None without histories and for dictionaries."""
    info, stacked = workers.info, workers.spec.frame_stack
    shape = info.spaces()[0].shape
    if not isinstance(space, spaces.Box) or not shape:
        return None
    if stacked > 1:
        newest = *shape[:-1], shape[-1] // stacked
        numbers = np.arange(math.prod(newest)).reshape(newest)
        source = np.concatenate([numbers] * stacked, axis=-1)
        back = np.broadcast_to(stacked - 1 - np.arange(shape[-1]) // newest[-1], shape)
    elif info.observation_history:
        source, back = info.layout.find_sources()
    else:
        return None
    source, back = (to_network_layout(part, space).ravel() for part in (source, back))
    privileged = np.arange(sum(workers.privileged_sizes.values()))
    return Stacking(np.concatenate([source, source.max() + 1 + privileged]), np.append(back, 0 * privileged))
