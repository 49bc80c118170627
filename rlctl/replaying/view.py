"""Camera pictures of an environment without a display: for films, and for pictures of a recorded episode."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import ArtifactError, UsageError, describe_exception
from rlctl.replaying.recorder import play_episode, recorded_actions
from rlctl.replaying.reproduce import find_difference
from rlctl.replaying.scene import Env, encode_jpeg, find_bounds
from rlctl.run.episode import RecordedEpisode
from rlctl.task import Sim
from rlctl.task.env import TaskEnv

Picture = NDArray[np.uint8]

_WIDTH, _HEIGHT = 240, 180  # [pixels], of a report's pictures
_EYE_DIRECTION = np.array([1.0, -0.9, 0.55])  # from the right of a robot that looks along x, from above
_FIELD_OF_VIEW = 45.0  # [degrees]
_CLOSEST, _FARTHEST = 0.8, 8.0  # [m]; the renderer draws nothing beyond 10 m


def look_at(env: Env, width: int, height: int) -> _World | _Pictures:
    """Return the view of an environment: a camera in a task's world, or the environment's own pictures.

    Pictures of a task have `width` and `height` [pixels].
    """
    inner = env.unwrapped
    return _World(inner, width, height) if isinstance(inner, TaskEnv) else _Pictures(env)


class _Pictures:
    """The environment's own pictures."""

    def __init__(self, env: Env) -> None:
        self._env = env

    def begin(self) -> None:
        """Prepare for a new episode."""

    def draw(self) -> Picture:
        """Return a picture of the present state, shape (height, width, 3)."""
        try:
            picture = np.asarray(self._env.render())
        except Exception as error:  # missing pygame, no OpenGL
            raise UsageError(f"the environment's render() raised {describe_exception(error)}") from None
        if picture.ndim != 3 or picture.shape[2] != 3:
            raise UsageError(f"the environment's render() returned {picture.dtype} of shape {picture.shape}")
        height, width = (size - size % 2 for size in picture.shape[:2])  # encoders need even sizes
        return np.ascontiguousarray(picture[:height, :width].astype(np.uint8))


class _World:
    """A task's PyBullet world, seen by a camera that follows the first robot that travels."""

    def __init__(self, env: TaskEnv, width: int, height: int) -> None:
        self._env = env
        self._size = width, height

    def begin(self) -> None:
        bodies = list(self._env.sim.bodies.values())
        robots = [body for body in bodies if body.joint_names] or bodies
        trunks = [(body, trunk) for body in robots if (trunk := body.find_trunk()) is not None]
        self._followed = trunks[0] if trunks else None
        markers = [np.asarray(position) for position in self._env.task.markers().values()]
        low, high = find_bounds([trunks[0][0]]) if trunks else find_bounds(bodies, markers)
        self._target, size = (low + high) / 2, float(np.linalg.norm(high - low))
        distances = [1.6 * size if trunks else 1.5 * size]
        if trunks:
            distances += [2.5 * float(np.linalg.norm(marker - self._target)) for marker in markers]
        self._offset = np.clip(max(distances), _CLOSEST, _FARTHEST) * _EYE_DIRECTION / np.linalg.norm(_EYE_DIRECTION)

    def draw(self) -> Picture:
        if self._followed is not None:
            body, trunk = self._followed
            # The height is constant: a gait would shake the film.
            self._target[:2] = body.mass_state(trunk).position[:2]
        self._env.move_markers()
        eye = self._target + self._offset
        target = self._target.tolist()
        return self._env.sim.render(*self._size, eye=eye.tolist(), target=target, field_of_view=_FIELD_OF_VIEW)


@dataclasses.dataclass(frozen=True)
class PictureStrip:
    """An episode in pictures."""

    pictures: list[tuple[int, bytes]]  # step and JPEG file
    deepest_contact: float  # how far bodies overlapped at most [m]; 0 without overlap, or without a task's world


def take_pictures(episode: RecordedEpisode, count: int) -> PictureStrip:
    """Play an episode again and return `count` steps of it, the first and the last among them.

    The camera follows the robot. Raises `TaskError` if the environment fails, `UsageError` if it cannot draw, and
    `ArtifactError` if it does something else than when it was recorded.
    """
    spec, steps = episode.info.spec, len(episode.actions)
    chosen = {int(step) for step in np.linspace(0, steps, count)}
    pictures: list[tuple[int, bytes]] = []
    deepest = 0.0
    env = spec.make("rgb_array")
    sim = getattr(env.unwrapped, "sim", None)
    try:
        view = look_at(env, _WIDTH, _HEIGHT)

        def watch(step: int) -> None:
            nonlocal deepest
            if isinstance(sim, Sim):
                deepest = max(deepest, sim.deepest_contact)
            if step == 0:
                view.begin()
            if step in chosen:
                pictures.append((step, encode_jpeg(view.draw())))

        choose = recorded_actions(episode, env)
        rollout = play_episode(env, spec, episode.info.seed, choose, policy=episode.info.policy, watch=watch)
    finally:
        env.close()
    if difference := find_difference(episode, rollout):
        raise ArtifactError(f"replayed, the episode differs from the recorded one; {difference}")
    return PictureStrip(pictures, deepest)
