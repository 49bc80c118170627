"""Times steps and resets, and looks at where the time goes."""

from __future__ import annotations

import functools
import re
import statistics
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rlctl.check_env.actions import actions
from rlctl.check_env.context import Context
from rlctl.check_env.instance import Instance
from rlctl.check_env.legacy import result
from rlctl.check_env.messages import Message
from rlctl.check_env.results import Speed
from rlctl.check_env.sampling import Sampler, Samples, Stopwatch

FIRST_SPEED_SEED = 5000
TIMED_STEPS = 200
TIMED_RESETS = 5
SAMPLED_S = 0.25
"""How long steps are sampled, and resets: some hundred samples each [s]."""
MOST_STEPS = 20_000
"""So many steps, or resets, are enough."""
BATCH = 25
"""The time of a step is the median of the means over so many: a disturbance is left out, a step that takes longer every
now and then is not."""
LONGEST_S = 2.0
"""So much time is enough, however much there is: an environment that takes longer for these steps is slow [s]."""
NAMED_CALLS = 5

KINDS = {
    "rendering": r"pybullet\.(getCameraImage|addUserDebug\w+)$|(matplotlib|pyglet|OpenGL|PIL\.ImageDraw)\.|"
    r"pygame\.(draw|gfxdraw|display|font|transform|surface|Surface)\b|"
    r"cv2\.(imshow|imwrite|line|circle|rectangle|polylines|fillPoly|putText|arrowedLine)$|"
    r"mujoco\.(mjr_render|renderer\.)|gymnasium\.envs\.mujoco\.mujoco_rendering\.",
    "sleeping": r"time\.sleep$|pygame\.time\.(wait|delay|Clock\.tick\w*)$|cv2\.waitKey\w*$",
    "connecting": r"pybullet\.connect$",
    "loading": r"pybullet\.(load(URDF|MJCF|SDF|SoftBody|Bullet|Texture|Plugin)|create(Collision|Visual)Shape\w*|"
    r"createMultiBody|createSoftBody\w*|resetSimulation)$|mujoco\..*from_(xml|binary)\w*$|"
    r"open$|(TextIOWrapper|Buffered\w+|FileIO)\.read\w*$",
}
"""What step and reset should not do, by the names of functions."""
_KINDS = {kind: re.compile(pattern) for kind, pattern in KINDS.items()}


def speed(context: Context) -> Iterator[Message]:
    """Live random episodes: first with nothing but a clock, then sampled."""
    instance, seconds = context.instance, min(LONGEST_S, context.budget.seconds_left)
    steps, resets = Stopwatch(), Stopwatch()
    _live(instance, steps, resets, TIMED_STEPS, TIMED_RESETS, time.monotonic() + seconds / 2)
    sampler = Sampler(own_code(instance.env), kind_of)
    in_step, in_reset = Samples(sampler), Samples(sampler)
    with sampler.running():
        _live(instance, in_step, in_reset, MOST_STEPS, 0, time.monotonic() + min(seconds / 4, SAMPLED_S))
        _live(instance, in_step, in_reset, 0, MOST_STEPS, time.monotonic() + min(seconds / 4, SAMPLED_S))
    yield result(
        Speed(
            step_s=typical(steps.seconds, BATCH),
            reset_s=typical(resets.seconds, 1),
            steps=len(steps.seconds),
            resets=len(resets.seconds),
            slowest_in_step=in_step.slowest()[:NAMED_CALLS],
            slowest_in_reset=in_reset.slowest()[:NAMED_CALLS],
            suspicious_in_step=in_step.suspicious(),
            suspicious_in_reset=in_reset.suspicious(),
            rebuilds=_rebuilds(instance.env),
        )
    )


def _live(instance: Instance, of_step: Any, of_reset: Any, steps: int, resets: int, deadline: float) -> None:
    """Take random steps, with a reset whenever an episode ends, and then the resets that are missing."""
    env = instance.env
    number = step = 0
    chosen: Iterator[Any] | None = None

    def reset() -> Iterator[Any]:
        seed = FIRST_SPEED_SEED + number
        instance.progress.episode(number, seed)
        keywords = {"seed": seed} if instance.accepts_seed else {}
        instance.call("reset", of_reset, env.reset, **keywords)
        return actions(env.action_space, "random", seed)

    for _ in range(steps):
        if chosen is None:
            chosen = reset()
            number, step = number + 1, 0
        step += 1
        action = instance.call("sample", next, chosen, step=step)
        if _ends(instance.call("step", of_step, env.step, action, step=step)):
            chosen = None
        if time.monotonic() > deadline:
            return
    while number < resets and time.monotonic() < deadline:
        reset()
        number += 1


def _ends(result: Any) -> bool:
    """Say whether an episode is over; one that returns nonsense is."""
    if not isinstance(result, tuple) or len(result) < 4:
        return True
    try:
        return any(bool(flag) for flag in result[2:-1])
    except Exception:  # the type of a flag is another rule's matter
        return True


def typical(seconds: Sequence[float], batch: int) -> float | None:
    """Return the median of the means of batches; those left over count only where there is no whole one."""
    if not seconds:
        return None
    batch = min(batch, len(seconds))
    starts = range(0, len(seconds) - batch + 1, batch)
    return statistics.median(statistics.fmean(seconds[start : start + batch]) for start in starts)


def own_code(env: Any) -> Callable[[str], bool]:
    """Return what says of a file whether it is the environment's own code, and no library's."""
    import rlctl

    paths = sysconfig.get_paths()
    libraries = [str(Path(rlctl.__file__).parent), *(paths[name] for name in ("stdlib", "purelib", "platlib"))]
    author = sys.modules.get(type(_author(env)).__module__)
    folder = str(Path(getattr(author, "__file__", None) or "/nowhere/at.all").parent)

    @functools.cache
    def is_own(file: str) -> bool:
        if file.startswith(f"{folder}/"):
            return True
        return not file.startswith(("<", *(f"{each}/" for each in libraries))) and "site-packages" not in file

    return is_own


def kind_of(name: str, own: bool) -> str:
    """Return what is suspicious about a function: a key of `KINDS`, or nothing."""
    if own:
        return "rendering" if name.rpartition(".")[2] in ("render", "_render") else ""
    return next((kind for kind, pattern in _KINDS.items() if pattern.match(name)), "")


def _author(env: Any) -> Any:
    """Return the object whose class somebody wrote: a task's environment is rlctl's."""
    inner = getattr(env, "unwrapped", env)
    return inner.task if _is_task(inner) else inner


def _is_task(inner: Any) -> bool:
    task_env = sys.modules.get("rlctl.task.env")
    return task_env is not None and isinstance(inner, task_env.TaskEnv)


def _rebuilds(env: Any) -> bool:
    inner = getattr(env, "unwrapped", env)
    return _is_task(inner) and not inner.task.fast_reset
