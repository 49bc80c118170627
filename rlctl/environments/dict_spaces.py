"""Spaces and observations as parts by key: those of a Dict space; any other space has one part."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

Observations = NDArray[Any] | dict[str, NDArray[Any]]
"""Observations of several rows: environments, or steps."""

LARGEST_SPACE = 10_000_000
"""Elements that the observations or the actions of an environment may have: a full-HD picture has 6 million."""

SINGLE = ""
"""The key of the only part of a space that is not a Dict."""


def split_space(space: spaces.Space[Any]) -> dict[str, spaces.Space[Any]]:
    """Return the parts of a space by key, in its order."""
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {SINGLE: space}


def split(observation: Any) -> dict[str, Any]:
    """Return the parts of an observation, or of several, by key."""
    return observation if isinstance(observation, dict) else {SINGLE: observation}


def join(parts: Mapping[str, Any]) -> Any:
    """Return the observation that `split` has taken apart."""
    return parts[SINGLE] if SINGLE in parts else dict(parts)


def map_parts(function: Callable[[Any], Any], observation: Any) -> Any:
    """Return an observation with `function` applied to each of its parts."""
    return join({key: function(part) for key, part in split(observation).items()})


def take_row(observations: Any, row: int) -> Any:
    """Return one observation of several."""
    return map_parts(lambda part: part[row], observations)


def stack(observations: Sequence[Any]) -> Observations:
    """Return observations as rows, shape (len(observations), ...)."""
    rows = [split(observation) for observation in observations]
    stacked: Observations = join({key: np.stack([row[key] for row in rows]) for key in rows[0]})
    return stacked


def split_names(observations: Any, sizes: Mapping[str, int]) -> dict[str, NDArray[Any]]:
    """Return observations of several rows by name, each of shape (rows, ...): by key, or by the sizes of what is flat.

    Of stacked observations it is the newest. Where nothing has a name there is one part.
    """
    parts = split(observations)
    if SINGLE not in parts or not sizes or parts[SINGLE].ndim != 2:
        return parts
    newest = parts[SINGLE][:, -sum(sizes.values()) :]
    return dict(zip(sizes, np.split(newest, np.cumsum([*sizes.values()])[:-1], axis=1), strict=True))


def format_space(space: Any, longest: int = 100) -> str:
    """Return a space as text of one line; of one that would be longer only its kind and shape."""
    text = " ".join(str(space).split())
    return text if len(text) <= longest else f"{type(space).__name__}{getattr(space, 'shape', None) or ''}"
