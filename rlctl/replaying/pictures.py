"""Shows episodes: films (`.mp4` or `.gif`) and pictures without a display, and windows.

A task is drawn by its engine, PyBullet's software renderer or MuJoCo, any other environment by its own `render()`.
"""

import contextlib
import dataclasses
import fractions
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments import registry
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, RlctlError, TaskError, UsageError, describe_exception, explain_missing_package
from rlctl.replaying.mujoco_scene import find_mujoco_bounds
from rlctl.replaying.recorder import Choose, Rollout, Watch, find_dt, play_episode, recorded_actions
from rlctl.replaying.report import FilmReport
from rlctl.replaying.reproduce import find_difference
from rlctl.replaying.scene import Env, encode_jpeg, find_bounds
from rlctl.run.episode import RecordedEpisode
from rlctl.storage import files
from rlctl.task import Body, Sim
from rlctl.task.env import TaskEnv
from rlctl.task.mujoco.sim import MujocoSim

Picture = NDArray[np.uint8]

_SIZE = {".mp4": (640, 480), ".gif": (400, 300)}  # [pixels], of a film
_RATE = {".mp4": 30.0, ".gif": 20.0}  # [1/s], at most
_DT = 1 / 30  # [s] per step, if an environment gives no time
_PAUSE_S = 0.5  # [s] at the end of each episode
_STRIP_SIZE = (240, 180)  # [pixels], of a report's pictures
_EYE_DIRECTION = np.array([1.0, -0.9, 0.55])  # from the right of a robot that looks along x, from above
_FIELD_OF_VIEW = 45.0  # [degrees]
_CLOSEST, _FARTHEST = 0.8, 8.0  # [m]; the renderer draws nothing beyond 10 m


class _Pictures:
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
    """A task's world, seen by a camera that follows the first robot that travels."""

    def __init__(self, env: TaskEnv, width: int, height: int) -> None:
        self._env = env
        self._size = width, height

    def begin(self) -> None:
        bodies = list(self._env.sim.bodies.values())
        robots = [body for body in bodies if body.joint_names] or bodies
        trunks = [(body, trunk) for body in robots if (trunk := body.find_trunk()) is not None]
        self._followed = trunks[0] if trunks else None
        markers = [np.asarray(position) for position in self._env.task.markers().values()]
        low, high = self._find_bounds([trunks[0][0]], []) if trunks else self._find_bounds(bodies, markers)
        self._target, size = (low + high) / 2, float(np.linalg.norm(high - low))
        distances = [1.6 * size if trunks else 1.5 * size]
        if trunks:
            distances += [2.5 * float(np.linalg.norm(marker - self._target)) for marker in markers]
        self._offset = np.clip(max(distances), _CLOSEST, _FARTHEST) * _EYE_DIRECTION / np.linalg.norm(_EYE_DIRECTION)

    def _find_bounds(self, bodies: list[Body], markers: list[NDArray[np.float64]]) -> tuple[Any, Any]:
        if isinstance(self._env.sim, MujocoSim):
            return find_mujoco_bounds(self._env.sim, bodies, markers)
        return find_bounds(bodies, markers)

    def draw(self) -> Picture:
        if self._followed is not None:
            body, trunk = self._followed
            # The height is constant: a gait would shake the film.
            self._target[:2] = body.mass_state(trunk).position[:2]
        self._env.move_markers()
        eye = self._target + self._offset
        target = self._target.tolist()
        return self._env.sim.render(*self._size, eye=eye.tolist(), target=target, field_of_view=_FIELD_OF_VIEW)


def look_at(env: Env, width: int, height: int) -> _World | _Pictures:
    """Return the view of an environment: a camera in a task's world, or the environment's own pictures.

    Pictures of a task have `width` and `height` [pixels].
    """
    inner = env.unwrapped
    return _World(inner, width, height) if isinstance(inner, TaskEnv) else _Pictures(env)


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
    with contextlib.closing(spec.make("rgb_array")) as env:
        sim = getattr(env.unwrapped, "sim", None)
        view = look_at(env, *_STRIP_SIZE)

        def watch(step: int) -> None:
            nonlocal deepest
            if isinstance(sim, Sim):
                deepest = max(deepest, sim.deepest_contact)
            if step == 0:
                view.begin()
            if step in chosen:
                pictures.append((step, encode_jpeg(view.draw())))

        choose = recorded_actions(episode, env.action_space)
        rollout = play_episode(env, spec, episode.info.seed, choose, policy=episode.info.policy, watch=watch)
    if difference := find_difference(episode, rollout):
        raise ArtifactError(f"the replayed episode differs from the recorded one; {difference}")
    return PictureStrip(pictures, deepest)


def check_file(path: Path) -> None:
    """Raise `UsageError` for a file that is not a film, or if the package that encodes it is not installed."""
    if path.suffix not in _SIZE:
        raise UsageError(f"--video {path}: give a file that ends in .mp4 or .gif")
    if path.suffix == ".mp4":
        try:
            import av  # noqa: F401
        except ImportError:
            missing = explain_missing_package(f"--video {path}", "PyAV", "video")
            raise UsageError(f"{missing}; or write a .gif, which needs no package") from None


def make_filmable(spec: EnvSpec) -> Env:
    """Build an environment for a film; raises `UsageError` if it makes no pictures."""
    try:
        return spec.make("rgb_array")
    except RlctlError as error:
        spec.make().close()  # raises again if the pictures were not the reason
        raise UsageError(f"--video: no pictures: {str(error).splitlines()[0]}") from None


def film_episodes(
    path: Path, env: Env, spec: EnvSpec, seeds: Sequence[int], begin: Callable[[int], Choose], *, policy: str
) -> tuple[list[Rollout], FilmReport]:
    """Play an episode per seed and write one film of all of them, atomically."""
    rollouts: list[Rollout] = []
    reports: list[FilmReport] = []

    def write(part: Path) -> None:
        film = _Film(env, part)
        for seed in seeds:
            rollouts.append(play_episode(env, spec, seed, begin(seed), policy=policy, watch=film.watch))
            film.pause()
        film.writer.close()
        reports.append(film.report(path))

    files.write_with(path, write)
    return rollouts, reports[0]


class _Film:
    def __init__(self, env: Env, path: Path) -> None:
        self._view = look_at(env, *_SIZE[path.suffix])
        dt = find_dt(env) or _DT
        self._every = max(1, round(1 / (_RATE[path.suffix] * dt)))
        self._rate = 1 / (dt * self._every)
        self._count, self._seconds = 0, 0.0
        self._is_taken = False
        self.writer = (_Mp4 if path.suffix == ".mp4" else _Gif)(path, self._rate)

    def watch(self, step: int) -> None:
        """Take a picture after the reset and after every n-th step."""
        if step == 0:
            self._view.begin()
        self._is_taken = step % self._every == 0
        if self._is_taken:
            self._take()

    def _take(self) -> None:
        start = time.perf_counter()
        self._last = self._view.draw()
        self._seconds += time.perf_counter() - start
        self._count += 1
        self.writer.add(self._last)

    def pause(self) -> None:
        """Take the last picture of an episode and show it for a moment."""
        if not self._is_taken:
            self._take()
        for _ in range(round(_PAUSE_S * self._rate)):
            self.writer.add(self._last)

    def report(self, path: Path) -> FilmReport:
        height, width = self._last.shape[:2]
        return FilmReport(path, self._count, width, height, self._rate, self._count / self._seconds)


class _Mp4:
    """H.264 in MP4, written by PyAV: browsers and slides can play it."""

    def __init__(self, path: Path, rate: float) -> None:
        import av

        self._av = av
        self._container = av.open(str(path), "w", format="mp4", options={"movflags": "faststart"})
        self._stream = self._container.add_stream("libx264", rate=fractions.Fraction(rate).limit_denominator(1000))
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": "20"}

    def add(self, picture: Picture) -> None:
        if self._stream.width != picture.shape[1]:
            self._stream.height, self._stream.width = picture.shape[:2]
        self._container.mux(self._stream.encode(self._av.VideoFrame.from_ndarray(picture, format="rgb24")))

    def close(self) -> None:
        self._container.mux(self._stream.encode())
        self._container.close()


class _Gif:
    """An animated GIF, written by Pillow at the end; pictures have 256 colours."""

    def __init__(self, path: Path, rate: float) -> None:
        self._path = path
        self._duration = round(1000 / rate)  # [ms]
        self._pictures: list[Any] = []

    def add(self, picture: Picture) -> None:
        from PIL import Image

        self._pictures.append(Image.fromarray(picture).quantize(256, dither=Image.Dither.NONE))

    def close(self) -> None:
        first, *rest = self._pictures
        first.save(self._path, "GIF", save_all=True, append_images=rest, duration=self._duration, loop=0)


def open_window(spec: EnvSpec) -> Env:
    """Build an environment with a window; raises `UsageError` without a display."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not display and not registry.is_task(spec.constructor()):
        raise UsageError("--gui: there is no display, DISPLAY is not set; leave out --gui to write a recording instead")
    return spec.make("human")


def show_episodes(env: Env, spec: EnvSpec, seeds: Sequence[int], begin: Callable[[int], Choose]) -> list[Rollout]:
    """Play an episode per seed in real time; closing PyBullet's window ends the replay without an error."""
    shown: list[Rollout] = []
    for seed in seeds:
        try:
            shown.append(play_episode(env, spec, seed, begin(seed), watch=_wait(find_dt(env) or _DT)))
        except TaskError as error:
            if "Not connected to physics server" not in str(error.__cause__):
                raise
            break
    return shown


def _wait(dt: float) -> Watch:
    """Return a function that waits after each step of `dt` [s], so that the episode plays in real time."""
    start: list[float] = []

    def wait(step: int) -> None:
        if step == 0:
            start.append(time.monotonic())
        time.sleep(max(0.0, start[0] + step * dt - time.monotonic()))

    return wait
