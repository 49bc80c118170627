"""PyBullet's window, or that of a Gymnasium environment: `--gui`."""

import os
import sys
import time
from collections.abc import Callable, Sequence

from rlctl.environments import registry
from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError, UsageError
from rlctl.replaying.recorder import Choose, Rollout, Watch, frame_time, play_episode
from rlctl.replaying.scene import Env

_DT = 1 / 30  # [s] per step, if an environment gives no time


def open_window(spec: EnvSpec) -> Env:
    """Build an environment with a window; raises `UsageError` without a display."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not display and not registry.is_task(spec.constructor()):
        raise UsageError("--gui: there is no display, DISPLAY is not set; leave out --gui to write a recording instead")
    return spec.make("human")


def show_episodes(env: Env, spec: EnvSpec, seeds: Sequence[int], begin: Callable[[int], Choose]) -> list[Rollout]:
    """Play an episode per seed in real time; closing PyBullet's window ends it early, without an error."""
    shown: list[Rollout] = []
    for seed in seeds:
        try:
            shown.append(play_episode(env, spec, seed, begin(seed), watch=_wait(frame_time(env) or _DT)))
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
