"""Camera pictures of environments that draw themselves."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.replay.live import Env

_MOST_PICTURES = 100  # of an episode: drawing one takes up to 40 ms
_LARGEST = 480  # [pixels]
_QUALITY = 80


class Camera:
    """Asks an environment for pictures, of long episodes only every few steps; one that cannot is asked once."""

    def __init__(self, env: Env, tell: Callable[[str], None]) -> None:
        self.pictures: list[tuple[int, bytes]] = []
        """Step and JPEG file."""
        self._env = env
        self._every = 1
        self._tell = tell
        self._works = env.render_mode == "rgb_array"

    def __call__(self, step: int) -> None:
        if step == 0:
            self.pictures, self._every = [], 1
        if not self._works or step % self._every:
            return
        try:
            picture = np.asarray(self._env.render())
            self.pictures.append((step, jpeg(picture)))
        except Exception as error:  # missing pygame, no OpenGL, no picture: the recording goes on without
            self._works = False
            self._tell(f"no camera pictures: {type(error).__name__}: {error}")
        if len(self.pictures) > _MOST_PICTURES:  # how long an episode will be is not known before
            self.pictures, self._every = self.pictures[::2], 2 * self._every


def jpeg(picture: NDArray[Any]) -> bytes:
    """Return a picture of shape (height, width, 1 or 3), uint8, as a JPEG file of at most 480 pixels a side."""
    from PIL import Image

    image = Image.fromarray(np.squeeze(picture, axis=-1) if picture.shape[-1] == 1 else picture)
    image.thumbnail((_LARGEST, _LARGEST))
    file = io.BytesIO()
    image.convert("RGB").save(file, "JPEG", quality=_QUALITY)
    return file.getvalue()
