"""Shows episodes as films (`.mp4` or `.gif`) and pictures, without a display.

A task is drawn by its engine, PyBullet's software renderer or MuJoCo, any other environment by its own `render()`, or,
where it has none, its PyBullet world by that renderer.
"""

import contextlib
import dataclasses
import fractions
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, UsageError, explain_missing_package
from rlctl.play.episode import RecordedEpisode
from rlctl.replaying.bullet_camera import Picture
from rlctl.replaying.camera import Viewpoint
from rlctl.replaying.captions import Caption
from rlctl.replaying.recorder import (
    DEFAULT_DT,
    Choose,
    Rollout,
    Watch,
    find_dt,
    join_watches,
    play_episode,
    recorded_actions,
)
from rlctl.replaying.report import FilmReport
from rlctl.replaying.reproduce import find_difference
from rlctl.replaying.scene import Env, Warn, encode_jpeg
from rlctl.replaying.views import look_at, make_filmable
from rlctl.storage import files
from rlctl.task import Sim
from rlctl.task.env import TaskEnv

Kept = TypeVar("Kept")
_SIZE = {".mp4": (640, 480), ".gif": (400, 300), ".png": (640, 480)}  # [pixels], of a film or a picture
_SMALLEST, _LARGEST = 64, 3840  # [pixels], of a side of a film
_RATE = {".mp4": 30.0, ".gif": 20.0, ".png": 30.0}  # [1/s], at most
_PAUSE_S = 0.5  # [s] at the end of each episode
_STRIP_SIZE = (240, 180)  # [pixels], of a report's pictures


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
    with contextlib.closing(make_filmable(spec)) as env:
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


def read_size(text: str | None) -> tuple[int, int] | None:
    """Read WIDTHxHEIGHT [pixels]; raises `UsageError` for anything else, and for odd numbers, which encoders refuse."""
    if text is None:
        return None
    parts = text.lower().split("x")
    numbers = [int(part) for part in parts if part.isascii() and part.isdigit()]
    is_possible = all(_SMALLEST <= number <= _LARGEST and number % 2 == 0 for number in numbers)
    if len(parts) != 2 or len(numbers) != 2 or not is_possible:
        raise UsageError(
            f"--size {text}: give WIDTHxHEIGHT, even numbers of pixels from {_SMALLEST} to {_LARGEST}, "
            "for example 1280x720"
        )
    return numbers[0], numbers[1]


def check_file(path: Path) -> None:
    """Raise `UsageError` for a file that is not a film, or if the package that encodes it is not installed."""
    if path.suffix not in _SIZE:
        raise UsageError(f"--video {path}: give a file that ends in .mp4 or .gif, or .png for one picture")
    if path.suffix == ".mp4":
        try:
            import av  # noqa: F401
        except ImportError:
            missing = explain_missing_package(f"--video {path}", "PyAV", "video")
            raise UsageError(f"{missing}; or write a .gif, which needs no package") from None


def film_episodes(
    path: Path,
    env: Env,
    spec: EnvSpec,
    seeds: Sequence[int],
    begin: Callable[[int], Choose],
    *,
    policy: str,
    keep: Callable[[int, Rollout], Kept],
    watch: Watch = lambda step: None,
    viewpoint: Viewpoint | None = None,
    size: tuple[int, int] | None = None,
    draw: Warn | None = None,
    at_s: float | None = None,
    longest_s: float | None = None,
) -> tuple[list[Kept], FilmReport]:
    """Play an episode per seed and write one film of all of them, atomically; `watch` is called after every step.

    `keep` is called with the number of each episode and its rollout, and what it returns is returned: a rollout is
    large, and is forgotten before the next one. `size` is width and height [pixels], by default that of the kind of
    file. With `draw` the rollouts have scenes, as in `play_episode`. Raises `UsageError` for an environment that makes
    no pictures, or none of that size.

    A `.png` is one picture of the only episode, `at_s` [s] after its start, by default in its middle. Raises
    `UsageError` for a time that the episode does not reach. With `longest_s` [s] a film has only the beginning of each
    episode, which is played to its end.
    """
    still = None
    if path.suffix == ".png":
        # The length of an episode is known after it: it is played once more, and drawn at one step only.
        rollout = play_episode(env, spec, seeds[0], begin(seeds[0]), policy=policy)
        still = _choose_step(len(rollout.episode.actions), find_dt(env) or DEFAULT_DT, at_s)
    kept: list[Kept] = []
    reports: list[FilmReport] = []

    def write(part: Path) -> None:
        film = _Film(env, part, viewpoint, size, still, longest_s)
        both = join_watches(watch, film.watch)
        for number, seed in enumerate(seeds):
            kept.append(keep(number, play_episode(env, spec, seed, begin(seed), policy=policy, watch=both, draw=draw)))
            film.pause()
        film.writer.close()
        reports.append(film.report(path))

    files.remove_abandoned(path)
    files.write_with(path, write)
    return kept, reports[0]


def _choose_step(steps: int, dt: float, at_s: float | None) -> int:
    """Return the step of an episode at a time, or in its middle."""
    if at_s is None:
        return steps // 2
    step = round(at_s / dt)
    if step > steps:
        raise UsageError(f"--at {at_s:g}: the episode ends after {steps * dt:.4g} s")
    return step


class _Film:
    def __init__(
        self,
        env: Env,
        path: Path,
        viewpoint: Viewpoint | None,
        size: tuple[int, int] | None = None,
        still: int | None = None,
        longest_s: float | None = None,
    ) -> None:
        """With `still` only this step is drawn, with `longest_s` [s] only the beginning of each episode."""
        self._still = still
        self._size = size
        width, self._height = size or _SIZE[path.suffix]
        self._view = look_at(env, width, self._height, viewpoint)
        inner = env.unwrapped
        self._caption = Caption(inner) if isinstance(inner, TaskEnv) else None
        self._step = 0
        self._dt = dt = find_dt(env) or DEFAULT_DT
        self._every = max(1, round(1 / (_RATE[path.suffix] * dt)))
        self._last_step = math.inf if longest_s is None else round(longest_s / dt)
        self._rate = 1 / (dt * self._every)
        self._count, self._seconds = 0, 0.0
        self._is_taken = False
        self.writer = _WRITERS[path.suffix](path, self._rate)

    def watch(self, step: int) -> None:
        """Take a picture after the reset and after every n-th step."""
        if step == 0:
            self._begin()
        if step > self._last_step:
            return
        self._step = step
        self._is_taken = step == self._still if self._still is not None else step % self._every == 0
        if self._is_taken:
            self._take()

    def _begin(self) -> None:
        headroom = 0.0 if self._caption is None else self._caption.find_headroom(self._height)
        try:
            self._view.begin(headroom)
        except UsageError as error:
            raise UsageError(f"--video: no pictures: {error}") from None
        if self._caption is not None:
            self._caption.begin()

    def _take(self) -> None:
        start = time.perf_counter()
        lines = [] if self._caption is None else self._caption.list_lines(self._step * self._dt)
        self._last = self._view.draw(lines)
        height, width = self._last.shape[:2]
        if self._size not in (None, (width, height)):
            raise UsageError(f"--size: this environment draws its own pictures of {width}x{height}: leave out --size")
        self._seconds += time.perf_counter() - start
        self._count += 1
        self.writer.add(self._last)

    def pause(self) -> None:
        """Take the last picture of an episode and show it for a moment; where the film ends before, the last taken."""
        if self._still is not None:
            return
        if not self._is_taken and self._step < self._last_step:
            self._take()
        for _ in range(round(_PAUSE_S * self._rate)):
            self.writer.add(self._last)

    def report(self, path: Path) -> FilmReport:
        height, width = self._last.shape[:2]
        return FilmReport(path, self.writer.count, width, height, self._rate, self._count / self._seconds)


class _Mp4:
    """H.264 in MP4, written by PyAV: browsers and slides can play it."""

    def __init__(self, path: Path, rate: float) -> None:
        import av

        self._av = av
        self._container = av.open(str(path), "w", format="mp4", options={"movflags": "faststart"})
        self._stream = self._container.add_stream("libx264", rate=fractions.Fraction(rate).limit_denominator(1000))
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": "20"}
        self.count = 0  # pictures in the file

    def add(self, picture: Picture) -> None:
        if self._stream.width != picture.shape[1]:
            self._stream.height, self._stream.width = picture.shape[:2]
        self._container.mux(self._stream.encode(self._av.VideoFrame.from_ndarray(picture, format="rgb24")))
        self.count += 1

    def close(self) -> None:
        self._container.mux(self._stream.encode())
        self._container.close()


class _Gif:
    """An animated GIF, written by Pillow at the end; pictures have 256 colours."""

    def __init__(self, path: Path, rate: float) -> None:
        self._path = path
        self._duration = round(1000 / rate)  # [ms]
        self._pictures: list[Any] = []
        self.count = 0  # pictures in the file, when it is written

    def add(self, picture: Picture) -> None:
        from PIL import Image

        self._pictures.append(Image.fromarray(picture).quantize(256, dither=Image.Dither.NONE))

    def close(self) -> None:
        from PIL import Image

        first, *rest = self._pictures
        first.save(self._path, "GIF", save_all=True, append_images=rest, duration=self._duration, loop=0)
        with Image.open(self._path) as written:  # equal pictures in a row are one that lasts longer
            self.count = getattr(written, "n_frames", 1)


class _Png:
    """One picture, written by Pillow."""

    count = 1

    def __init__(self, path: Path, rate: float) -> None:
        self._path = path

    def add(self, picture: Picture) -> None:
        from PIL import Image

        Image.fromarray(picture).save(self._path, format="PNG")

    def close(self) -> None:
        """It is written already."""


_WRITERS: dict[str, type[_Mp4] | type[_Gif] | type[_Png]] = {".mp4": _Mp4, ".gif": _Gif, ".png": _Png}
