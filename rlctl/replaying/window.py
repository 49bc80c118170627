"""Shows episodes in a window, in real time: PyBullet's for a task, or the environment's own."""

import os
import sys
import time
from collections.abc import Callable, Sequence

from rlctl.environments import registry
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RlctlError, TaskError, UsageError
from rlctl.replaying.recorder import DEFAULT_DT, Choose, Rollout, Watch, find_dt, join_watches, play_episode
from rlctl.replaying.scene import Env
from rlctl.task.pybullet.library import pybullet


def open_window(spec: EnvSpec) -> Env:
    """Build an environment with a window; raises `UsageError` without a display, or if it has no window."""
    if registry.is_task(spec.constructor()):
        return spec.make("human")
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not display:
        raise UsageError("--gui: there is no display, DISPLAY is not set; leave out --gui to write a recording instead")
    try:
        return spec.make("human")
    except RlctlError as error:
        spec.make().close()  # raises again if the window was not the reason
        what = str(error).splitlines()[0]
        raise UsageError(f"--gui: no window: {what}; leave out --gui to write a recording instead") from None


def show_episodes(
    env: Env,
    spec: EnvSpec,
    seeds: Sequence[int],
    begin: Callable[[int], Choose],
    *,
    watch: Watch = lambda step: None,
) -> list[Rollout]:
    """Play an episode per seed in real time; closing PyBullet's window ends the replay without an error.

    `watch` is called after every step.
    """
    shown: list[Rollout] = []
    for seed in seeds:
        try:
            both = join_watches(watch, _wait(find_dt(env) or DEFAULT_DT))
            shown.append(play_episode(env, spec, seed, begin(seed), watch=both))
        except (TaskError, pybullet.error) as error:
            if "Not connected to physics server" not in str(error.__cause__ or error):
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
