"""Split spaces and observations into parts by key. A Dict space has a part per key, any other space one part."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

Observations = NDArray[Any] | dict[str, NDArray[Any]]  # a batch of observations; a row per environment or per step

LARGEST_SPACE = 10_000_000
"""Maximum number of elements of an observation or action space; a full-HD picture has 6 million."""

SINGLE = ""  # the key of the only part of a space that is not a Dict


def split_space(space: spaces.Space[Any]) -> dict[str, spaces.Space[Any]]:
    """Return the parts of a space by key, in its order."""
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {SINGLE: space}


def split(observation: Any) -> dict[str, Any]:
    """Return the parts of an observation, or of several, by key."""
    return observation if isinstance(observation, dict) else {SINGLE: observation}


def join(parts: Mapping[str, Any]) -> Any:
    """Return the observation whose parts these are; the inverse of `split`."""
    return parts[SINGLE] if SINGLE in parts else dict(parts)


def map_parts(function: Callable[[Any], Any], observation: Any) -> Any:
    """Return an observation with `function` applied to each of its parts."""
    return join({key: function(part) for key, part in split(observation).items()})


def take_row(observations: Any, row: int) -> Any:
    """Return one observation of a batch."""
    return map_parts(lambda part: part[row], observations)


def stack(observations: Sequence[Any]) -> Observations:
    """Return observations as rows, shape (len(observations), ...)."""
    rows = [split(observation) for observation in observations]
    return join({key: np.stack([row[key] for row in rows]) for key in rows[0]})


def split_names(observations: Any, sizes: Mapping[str, int]) -> dict[str, NDArray[Any]]:
    """Split a batch of observations by name; each part has shape (rows, ...).

    A Dict is split by key, a flat observation by `sizes`; of stacked frames only the newest is returned. Without names
    the result is one part.
    """
    parts = split(observations)
    if SINGLE not in parts or not sizes or parts[SINGLE].ndim != 2:
        return parts
    newest = parts[SINGLE][:, -sum(sizes.values()) :]
    return dict(zip(sizes, np.split(newest, np.cumsum([*sizes.values()])[:-1], axis=1), strict=True))


def count_outside(space: spaces.Space[Any], observations: Mapping[str, NDArray[Any]]) -> tuple[int, str]:
    """Count observations, shape (n_envs, steps, ...), outside their space; return also a message about one."""
    outside: Any = False  # later an array, one element per observation
    message = ""
    for key, box in split_space(space).items():
        if not isinstance(box, spaces.Box) or box.dtype == np.uint8:
            continue
        values = observations[key]
        wrong = ((values < box.low) | (values > box.high)).reshape(*values.shape[:2], -1)
        if wrong.any():
            outside |= wrong.any(axis=2)
            env, step, element = np.argwhere(wrong)[0].tolist()
            value, low, high = (array.ravel()[element] for array in (values[env, step], box.low, box.high))
            name = f"observation {key!r}" if key else "observation"
            message = f"{name} is outside its space: element {element} is {value:.6g}, not {low:g} to {high:g}"
    return int(np.count_nonzero(outside)), message


def is_image(space: spaces.Space[Any]) -> bool:
    """Return whether a space is of images, as Stable-Baselines3 defines them: uint8 from 0 to 255, three axes."""
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8 or len(space.shape) != 3:
        return False
    return bool((space.low == 0).all() and (space.high == 255).all())


def format_space(space: Any, longest: int = 100) -> str:
    """Return a space as one line of text; if that is longer than `longest`, only its kind and shape."""
    text = " ".join(str(space).split())
    return text if len(text) <= longest else f"{type(space).__name__}{getattr(space, 'shape', None) or ''}"
