"""Which code is the environment's own, and which functions its step and reset should not call."""

from __future__ import annotations

import functools
import re
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Any

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


def find_own_code(env: Any) -> Callable[[str], bool]:
    """Return what decides of a file whether it is the environment's own code, and no library's."""
    import rlctl

    paths = sysconfig.get_paths()
    libraries = [str(Path(rlctl.__file__).parent), *(paths[name] for name in ("stdlib", "purelib", "platlib"))]
    author = sys.modules.get(type(find_author(env)).__module__)
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


def find_author(env: Any) -> Any:
    """Return the object whose class the environment's author wrote: not rlctl's environment of a task, but the task."""
    inner = getattr(env, "unwrapped", env)
    return inner.task if is_task(env) else inner


def is_task(env: Any) -> bool:
    """Say whether it is an environment of a task of rlctl."""
    task_env = sys.modules.get("rlctl.task.env")
    return task_env is not None and isinstance(getattr(env, "unwrapped", env), task_env.TaskEnv)


def find_time_limit(env: Any) -> int | None:
    """Return after how many steps an environment says that its episodes end; None where it does not."""
    if is_task(env):
        return int(env.unwrapped.max_steps)
    return getattr(getattr(env, "spec", None), "max_episode_steps", None)


def rebuilds_world(env: Any) -> bool:
    """Say whether it is a task that declares that every reset loads the world anew."""
    return is_task(env) and not find_author(env).fast_reset
