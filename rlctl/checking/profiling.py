"""Times calls on a busy machine, and finds the functions that take the time."""

import cProfile
import dataclasses
import functools
import re
import sys
import sysconfig
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rlctl.checking.progress import read_waited_s
from rlctl.checking.values import find_author
from rlctl.environments import bullet_calls
from rlctl.version import PACKAGE_FOLDER

_BUILTIN = re.compile(
    r"<built-in method (?P<function>.+)>|<method '(?P<method>.+)' of '(?P<of>.+)' objects>|<(?P<bare>.+)>"
)
"""How the profiler names functions that are not written in Python."""

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
"""What step and reset should not do, by patterns of the names of functions."""


class Stopwatch:
    """Calls functions and records their times, without the time of waiting for a processor [s]."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    def __call__(self, function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        """Call the function and return what it returns."""
        waited_s, started = read_waited_s(), time.perf_counter()
        value = function(*arguments, **keywords)
        ended = time.perf_counter()
        self.seconds.append(max(0.0, ended - started - (read_waited_s() - waited_s)))
        return value


@dataclasses.dataclass(frozen=True)
class TimedCall:
    """The calls of one function in all steps, or in all resets."""

    name: str  # `pybullet.stepSimulation`
    place: str  # `file.py:12` in the environment; empty if not known
    share: float  # Its part of the time of all steps, or of all resets
    kind: str = ""  # `rendering`, `sleeping`, `loading` or `connecting`, for what is suspicious


Function = tuple[str, int, str]  # file, line, name, as in cProfile


class Profile:
    """The functions that were called under a profiler, and their callers; `is_own` says whether a file is the
    environment's. Run the profiler inside `bullet_calls.visible_to_profilers`."""

    def __init__(self, profile: cProfile.Profile, is_own: Callable[[str], bool]) -> None:
        profile.create_stats()
        self._stats: dict[Function, Any] = {
            function: stats for function, stats in profile.stats.items() if "_lsprof.Profiler" not in function[2]
        }
        """Per function the number of calls, twice, the time in itself and with all it calls [s], the same by caller."""
        self._own = {function for function in self._stats if function[0] != "~" and is_own(function[0])}
        modules = {getattr(module, "__dict__", {}).get("__file__"): name for name, module in list(sys.modules.items())}
        self._names = {key: key[2] if key in self._own else _name_of(key, modules) for key in self._stats}
        self._kinds = {function: _kind_of(name, function in self._own) for function, name in self._names.items()}

    def slowest(self) -> list[TimedCall]:
        """Return the functions by the time in themselves, the slowest first."""
        return self._sum_up([(function, self._place(function), stats[2]) for function, stats in self._stats.items()])

    def suspicious(self) -> list[TimedCall]:
        """Return the functions of a suspicious kind that no other such calls, with the time in all they call."""
        calls = []
        for function in (function for function, kind in self._kinds.items() if kind):
            for caller, spent in self._stats[function][4].items():
                if not self._kinds[caller]:
                    calls.append((function, self._place(function if function in self._own else caller), spent[3]))
        return self._sum_up(calls)

    def _place(self, function: Function | None) -> str:
        """Return the place of a function, or of the own function that most of its time is spent for."""
        seen = set()
        while function is not None and function not in self._own:
            seen.add(function)
            callers = {caller: spent[3] for caller, spent in self._stats[function][4].items() if caller not in seen}
            function = max(callers, key=lambda caller: callers[caller], default=None)
        return "" if function is None else f"{Path(function[0]).name}:{function[1]}"

    def _sum_up(self, calls: Sequence[tuple[Function, str, float]]) -> list[TimedCall]:
        total = sum(stats[2] for stats in self._stats.values()) or 1.0
        by_name: dict[str, TimedCall] = {}
        for function, place, spent in sorted(calls, key=lambda call: -call[2]):
            name = self._names[function]
            call = by_name.setdefault(name, TimedCall(name, place, 0.0, self._kinds[function]))
            by_name[name] = dataclasses.replace(call, share=call.share + spent / total)
        return sorted(by_name.values(), key=lambda call: -call.share)


def _name_of(function: Function, modules: dict[Any, str]) -> str:
    file, _, name = function
    if file == bullet_calls.__file__:
        name = f"pybullet.{name}"
    elif file != "~":
        name = f"{modules.get(file, '')}.{name}"
    elif (match := _BUILTIN.fullmatch(name)) is None:
        return name
    elif match["bare"]:  # OpenCV's functions do not say whose they are
        name = f"cv2.{match['bare']}" if hasattr(sys.modules.get("cv2"), match["bare"]) else match["bare"]
    else:
        name = match["function"] or f"{match['of']}.{match['method']}"
    *parts, last = name.removeprefix("builtins.").removeprefix("io.").split(".")
    return ".".join([*(part for part in parts if part and not part.startswith("_")), last])


def find_own_code(env: Any) -> Callable[[str], bool]:
    """Return the function that says whether a file is the environment's own code, not a library's."""
    paths = sysconfig.get_paths()
    libraries = [str(PACKAGE_FOLDER), *(paths[name] for name in ("stdlib", "purelib", "platlib"))]
    author = sys.modules.get(type(find_author(env)).__module__)
    folder = str(Path(getattr(author, "__file__", None) or "/nowhere/at.all").parent)

    @functools.cache
    def is_own(file: str) -> bool:
        is_library = file.startswith(("<", *(f"{library}/" for library in libraries))) or "site-packages" in file
        return file.startswith(f"{folder}/") or not is_library

    return is_own


def _kind_of(name: str, own: bool) -> str:
    if own:
        return "rendering" if name.rpartition(".")[2] in ("render", "_render") else ""
    return next((kind for kind, pattern in KINDS.items() if re.match(pattern, name)), "")
