"""Times calls on a busy machine, and samples what they spend their time on.

A timer's signal interrupts them every half millisecond. That names a builtin too: Python handles signals right after a
builtin has come back, so the instruction that the innermost frame is at is the call of it. A thread would not do: it
gets to look where the lock of the interpreter is released, which some functions do all the time.
"""

from __future__ import annotations

import ast
import builtins
import contextlib
import dataclasses
import dis
import functools
import inspect
import linecache
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

from rlctl.check_env.clock import read_waited_s

INTERVAL_S = 0.0005
_FOLDER = f"{Path(__file__).parent}/"


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
    """Where in the environment's code most of its time goes, `file.py:12`; empty if there is none."""
    share: float
    """Its part of the time of all steps, or of all resets."""
    kind: str = ""
    """`rendering`, `sleeping`, `loading` or `connecting`, for what is suspicious."""
    inside: str = ""
    """Another suspicious function that it calls itself."""


@dataclasses.dataclass(frozen=True, slots=True)
class _Call:
    """A call that a sample found on the stack."""

    name: str
    place: str
    """`file.py:12`: an own function's first line, or the own line that leads to a library's."""
    kind: str


class Samples:
    """Calls functions, and sums up per function the time of the samples that were taken in them."""

    def __init__(self, sampler: Sampler) -> None:
        self._sampler = sampler
        self.seconds = 0.0
        self._innermost: dict[_Call, float] = {}
        self._suspicious: dict[_Call, float] = {}
        self._inside: dict[str, str] = {}

    def __call__(self, function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        """Call the function and return what it returns."""
        self._sampler.into = self
        try:
            return function(*arguments, **keywords)
        finally:
            self._sampler.into = None

    def add(self, stack: list[_Call], seconds: float) -> None:
        """Add a sample: the calls that were open, the outermost first, and the time since the sample before."""
        self.seconds += seconds
        self._innermost[stack[-1]] = self._innermost.get(stack[-1], 0.0) + seconds
        suspicious = [each for each in stack if each.kind]
        for outer in suspicious[:1]:
            self._suspicious[outer] = self._suspicious.get(outer, 0.0) + seconds
        for inner in suspicious[1:2]:
            self._inside.setdefault(suspicious[0].name, inner.name)

    def slowest(self) -> list[TimedCall]:
        """Return the functions by the time in themselves, the slowest first."""
        return self._shares(self._innermost)

    def suspicious(self) -> list[TimedCall]:
        """Return the functions of a suspicious kind that no other such contains, with the time in all they call."""
        return self._shares(self._suspicious)

    def _shares(self, times: dict[_Call, float]) -> list[TimedCall]:
        ordered = sorted(times, key=lambda each: -times[each])
        totals = {each.name: 0.0 for each in ordered}
        for each in ordered:
            totals[each.name] += times[each] / self.seconds
        first = {each.name: each for each in reversed(ordered)}  # the place where most of its time goes
        calls = [
            TimedCall(name, first[name].place, share, first[name].kind, self._inside.get(name, ""))
            for name, share in totals.items()
        ]
        return sorted(calls, key=lambda each: -each.share)


class Sampler:
    """Takes samples of the main thread, within `running`, while one of its `Samples` calls a function."""

    def __init__(self, is_own: Callable[[str], bool], kind_of: Callable[[str, bool], str]) -> None:
        self.into: Samples | None = None
        self._is_own, self._kind_of = is_own, kind_of
        self._functions: dict[CodeType, tuple[str, bool]] = {}
        self._builtins: dict[tuple[CodeType, int], tuple[str, bool]] = {}
        self._is_running, self._last = False, 0.0
        self._error: Exception | None = None

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Take samples; raises what went wrong in taking them."""
        handler = signal.signal(signal.SIGALRM, self._take)
        signal.siginterrupt(signal.SIGALRM, False)  # reading and writing in libraries goes on
        self._is_running, self._last = True, _clock()
        timer = signal.setitimer(signal.ITIMER_REAL, INTERVAL_S)
        try:
            yield
        finally:
            self._is_running = False  # so that a signal that is on its way does not start the timer again
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, handler)
            signal.setitimer(signal.ITIMER_REAL, *timer)
        if self._error is not None:
            raise self._error

    def _take(self, number: int, frame: FrameType | None) -> None:
        if not self._is_running:
            return
        try:
            if self.into is not None and (stack := self._stack(frame)):
                # The weight is the time since the last sample: no signal is handled inside a builtin.
                self.into.add(stack, max(0.0, _clock() - self._last))
        except Exception as error:  # raised here it would be the environment's
            self._error = error
            return
        self._last = _clock()
        signal.setitimer(signal.ITIMER_REAL, INTERVAL_S)

    def _stack(self, frame: FrameType | None) -> list[_Call]:
        """Return the open calls of the environment's code, the outermost first; empty while it is not running."""
        frames: list[FrameType] = []
        while frame is not None and not frame.f_code.co_filename.startswith(_FOLDER):
            frames.insert(0, frame)
            frame = frame.f_back
        begins = len(frames) > 1 and _operation(frames[-1]) == "RESUME"
        if begins:
            frames.pop()  # the time before it is the caller's
        stack, place = [], ""
        for each in frames:
            name, own = self._function(each)
            file = Path(each.f_code.co_filename).name
            place = f"{file}:{each.f_lineno}" if own else place
            at = f"{file}:{each.f_code.co_firstlineno}" if own else place
            stack.append(_Call(name, at, self._kind_of(name, own)))
            if "CALL" in _operation(each):  # CALL, CALL_FUNCTION_EX; Python 3.11 has PRECALL too
                name, is_builtin = self._called(each)
                if is_builtin or (each is frames[-1] and not begins):
                    stack.append(_Call(name, place, self._kind_of(name, False)))
        return stack

    def _function(self, frame: FrameType) -> tuple[str, bool]:
        code = frame.f_code
        if code not in self._functions:
            own, name = self._is_own(code.co_filename), code.co_qualname
            full = name if own else f"{frame.f_globals.get('__name__', '')}.{name}"
            self._functions[code] = _public(full), own
        return self._functions[code]

    def _called(self, frame: FrameType) -> tuple[str, bool]:
        key = frame.f_code, frame.f_lasti
        if key not in self._builtins:
            self._builtins[key] = _called(frame)
        return self._builtins[key]


def _clock() -> float:
    return time.perf_counter() - read_waited_s()


def _operation(frame: FrameType) -> str:
    return dis.opname[frame.f_code.co_code[frame.f_lasti]]


def _called(frame: FrameType) -> tuple[str, bool]:
    """Return the name of what a frame is calling, from the text of the call, and whether that is a builtin for sure."""
    text = _call_text(frame.f_code, frame.f_lasti)
    root, *attributes = text.split(".")
    scopes: Iterable[Any] = (frame.f_locals, frame.f_globals, vars(builtins))
    value = next((scope[root] for scope in scopes if root in scope), None)
    for name in attributes:
        # Nothing of the environment's runs here: no property, no __getattr__.
        look_up = getattr if isinstance(value, ModuleType) else inspect.getattr_static
        value = look_up(value, name, None)
    value = value.func if isinstance(value, functools.partial) else value
    if callable(value):
        return _name_of(value), not hasattr(value, "__code__") and not isinstance(value, type)
    last = text.rpartition(".")[2]
    # BulletClient finds PyBullet's functions in a __getattr__.
    is_bullet = inspect.isbuiltin(getattr(sys.modules.get("pybullet"), last, None))
    return f"pybullet.{last}" if is_bullet else text.removeprefix("self.") or frame.f_code.co_qualname, False


def _call_text(code: CodeType, offset: int) -> str:
    """Return how the function is written that an instruction calls: `self.bullet.stepSimulation`."""
    line, end_line, column, end_column = list(code.co_positions())[offset // 2]
    if line is None or end_line is None:
        return ""
    lines = [each.encode() for each in linecache.getlines(code.co_filename)[line - 1 : end_line]]
    if not lines:
        return ""
    lines[-1] = lines[-1][:end_column]
    lines[0] = lines[0][column:]
    try:
        call = ast.parse(f"({b''.join(lines).decode()})", mode="eval").body
    except (SyntaxError, ValueError):
        return ""
    return ast.unparse(call.func) if isinstance(call, ast.Call) else ""


def _name_of(function: Any) -> str:
    name = str(getattr(function, "__qualname__", "") or getattr(function, "__name__", type(function).__name__))
    owner = getattr(function, "__objclass__", None)
    module = getattr(owner or function, "__module__", None)
    if module is None and getattr(sys.modules.get("cv2"), name, None) is function:
        module = "cv2"  # whose functions do not say so
    return _public(f"{module}.{name}" if module else name)


@functools.cache
def _public(name: str) -> str:
    """Leave out private modules: `numpy.linalg._linalg.norm` is `numpy.linalg.norm`, `io.open` is `open`."""
    name = name.replace("<locals>.", "").removeprefix("builtins.").removeprefix("io.")
    *modules, function = name.split(".")
    return ".".join([*(each for each in modules if not each.startswith("_")), function])
