"""Times calls on a busy machine, and says which functions their time goes to."""

from __future__ import annotations

import cProfile
import dataclasses
import functools
import re
import sys
import sysconfig
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from types import CodeType
from typing import Any

from rlctl.check_env import bullet_calls
from rlctl.check_env.clock import read_waited_s
from rlctl.check_env.instance import find_author

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
    """Calls functions, and keeps how long each took without the time in which it waited for a processor [s]."""

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

    name: str
    """`pybullet.stepSimulation`."""
    place: str
    """The function of the environment that most of its time is spent for, `file.py:12`; empty if there is none."""
    share: float
    """Its part of the time of all steps, or of all resets."""
    kind: str = ""
    """`rendering`, `sleeping`, `loading` or `connecting`, for what is suspicious."""


class Profiler:
    """Calls functions under Python's profiler; use it inside `bullet_calls.visible_to_profilers`."""

    def __init__(self) -> None:
        self._profile = cProfile.Profile()

    def __call__(self, function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        """Call the function and return what it returns."""
        self._profile.enable()
        try:
            return function(*arguments, **keywords)
        finally:
            self._profile.disable()

    def profile(self, is_own: Callable[[str], bool]) -> Profile:
        """Return where the time went; `is_own` says of a file whether it is the environment's own code."""
        return Profile(self._profile.getstats(), is_own)


@dataclasses.dataclass
class _Function:
    name: str
    place: str
    """Of the environment's own functions only."""
    kind: str
    own_s: float = 0.0
    """The time in itself [s]."""


class Profile:
    """The functions that were called, and by whom."""

    def __init__(self, stats: list[Any], is_own: Callable[[str], bool]) -> None:
        modules = {getattr(each, "__dict__", {}).get("__file__"): name for name, each in list(sys.modules.items())}
        self._functions: dict[Any, _Function] = {}
        self._callers: dict[Any, Counter[Any]] = defaultdict(Counter)
        """What calls a function, with the time of that and of all it calls [s]."""
        for entry in stats:
            own = isinstance(entry.code, CodeType) and is_own(entry.code.co_filename)
            name = _name_of(entry.code, own, modules)
            place = f"{Path(entry.code.co_filename).name}:{entry.code.co_firstlineno}" if own else ""
            function = self._functions.setdefault(entry.code, _Function(name, place, _kind_of(name, own)))
            function.own_s += entry.inlinetime
            for each in entry.calls or ():
                self._callers[each.code][entry.code] += each.totaltime
        self._seconds = sum(each.own_s for each in self._functions.values()) or 1.0

    def slowest(self) -> list[TimedCall]:
        """Return the functions by the time in themselves, the slowest first."""
        return self._sum_up([(code, self._place(code), each.own_s) for code, each in self._functions.items()])

    def suspicious(self) -> list[TimedCall]:
        """Return the functions of a suspicious kind that no other such calls, with the time in all they call."""
        return self._sum_up(
            [
                (code, self._functions[code].place or self._place(caller), seconds)
                for code, callers in self._callers.items()
                for caller, seconds in callers.items()
                if self._functions[code].kind and not self._functions[caller].kind
            ]
        )

    def _place(self, code: Any) -> str:
        """Return the place of a function, or of the own function that most of its time is spent for."""
        seen = set()
        while code is not None and not self._functions[code].place:
            seen.add(code)
            callers = [each for each, _ in self._callers.get(code, Counter()).most_common() if each not in seen]
            code = callers[0] if callers else None
        return "" if code is None else self._functions[code].place

    def _sum_up(self, calls: Sequence[tuple[Any, str, float]]) -> list[TimedCall]:
        """Return one call per name, with the place where most of its time goes, the slowest first."""
        seconds: dict[str, float] = {}
        first: dict[str, tuple[Any, str]] = {}
        for code, place, spent in sorted(calls, key=lambda each: -each[2]):
            name = self._functions[code].name
            first.setdefault(name, (code, place))
            seconds[name] = seconds.get(name, 0.0) + spent
        timed = [
            TimedCall(name, place, seconds[name] / self._seconds, self._functions[code].kind)
            for name, (code, place) in first.items()
        ]
        return sorted(timed, key=lambda each: -each.share)


def _name_of(code: CodeType | str, own: bool, modules: dict[Any, str]) -> str:
    """Return a function's name without private modules: `numpy.linalg.norm`, `open`, `Ant.observe`."""
    if isinstance(code, CodeType) and own:
        return code.co_qualname.replace("<locals>.", "")
    if isinstance(code, CodeType):
        is_replaced = code.co_filename == bullet_calls.__file__
        name = f"{'pybullet' if is_replaced else modules.get(code.co_filename, '')}.{code.co_qualname}"
    elif (match := _BUILTIN.fullmatch(code)) is None:
        return code
    elif match["bare"]:  # OpenCV's functions do not say whose they are
        name = f"cv2.{match['bare']}" if hasattr(sys.modules.get("cv2"), match["bare"]) else match["bare"]
    else:
        name = match["function"] or f"{match['of']}.{match['method']}"
    *parts, function = name.replace("<locals>.", "").removeprefix("builtins.").removeprefix("io.").split(".")
    return ".".join([*(each for each in parts if each and not each.startswith("_")), function])


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


def _kind_of(name: str, own: bool) -> str:
    """Return what is suspicious about a function: a key of `KINDS`, or nothing."""
    if own:
        return "rendering" if name.rpartition(".")[2] in ("render", "_render") else ""
    return next((kind for kind, pattern in KINDS.items() if re.match(pattern, name)), "")
