"""Which calls the environment's code makes and how long each takes: Python's functions and builtins alike.

`cProfile` would do, but for two things: it does not say which line of the environment a builtin is called from, and
it does not see what goes through `functools.partial`, as all calls of PyBullet's `BulletClient` do. So this is a
profiler of its own, on the same events; the time that it takes itself is left out.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import sys
import time
from collections.abc import Callable, Iterable
from types import CodeType, FrameType, FunctionType
from typing import Any


@dataclasses.dataclass(slots=True)
class Calls:
    """The calls of one function from one place."""

    name: str
    file: str
    line: int
    count: int = 0
    own_s: float = 0.0
    """Time in the function itself, what it calls left out [s]."""
    kind: str = ""
    """What is suspicious about it, if anything is."""
    whole_s: float = 0.0
    """Time in it and in what it calls [s]; counted only for a suspicious one that no other of its kind contains."""
    whole_count: int = 0
    inside: str = ""
    """The first suspicious function that it calls itself."""


@dataclasses.dataclass(slots=True)
class _Open:
    """A call that has not come back."""

    calls: Calls
    frame: FrameType | None
    """Its frame; None for a builtin."""
    nearest: FrameType | None
    """The innermost frame of the environment's own code."""
    began: float = -1.0
    """On the profile's clock, for the outermost suspicious call only [s]."""
    partial: Calls | None = None
    """A builtin that was fetched as a partial and is about to be called: no event will tell when."""
    from_offset: int = 0
    to_offset: int = 0
    """The instructions of the expression in which that happens."""


class CallTimes:
    """Times the calls that a function makes: `times(env.step, action)`."""

    def __init__(self, is_own: Callable[[str], bool], kind_of: Callable[[str, bool], str]) -> None:
        self.seconds = 0.0
        """Time in all that was called [s]; the clock of this profile."""
        self.error: Exception | None = None
        """What this profile itself raised: inside of what it watches it would look like the environment's own."""
        self._kind_of = kind_of
        self._own = is_own
        self._calls: dict[tuple[str, str, int], Calls] = {}
        self._functions: dict[CodeType, tuple[str, bool]] = {}
        self._open: list[_Open] = []
        self._within: Calls | None = None
        self._last = 0.0
        self._is_python = True

    def __call__(self, function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        """Call the function and return what it returns."""
        before = sys.getprofile()
        self._is_python = isinstance(getattr(function, "__func__", function), FunctionType)
        root = self._of(getattr(function, "__qualname__", "call"), False, None, None)
        root.count += not self._is_python
        self._open, self._within = [_Open(root, None, None)], None
        self._last = time.perf_counter()
        sys.setprofile(self._event)
        try:
            return function(*arguments, **keywords)
        finally:
            sys.setprofile(before)
            while len(self._open) > 1:
                self._close()

    @property
    def calls(self) -> Iterable[Calls]:
        """Every function that was called, per place in the environment's code."""
        return self._calls.values()

    def _event(self, frame: FrameType, event: str, argument: Any) -> None:
        self._charge(time.perf_counter() - self._last)
        try:
            self._note(frame, event, argument)
        except Exception as error:
            self.error = error
            sys.setprofile(None)
        self._last = time.perf_counter()

    def _note(self, frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            self._enter_function(frame)
        elif event == "c_call":
            self._enter(_Open(self._of_builtin(argument, frame), None, self._open[-1].nearest))
        elif event == "return":
            self._leave_function(frame, argument)
        elif self._open[-1].frame is None and len(self._open) > 1:
            self._close()

    def _charge(self, seconds: float) -> None:
        """Book the time since the last event on the call that is running."""
        if len(self._open) == 1 and self._is_python:
            return  # on the way into the function and out of it
        self.seconds += seconds
        top = self._open[-1]
        if top.partial is None:
            top.calls.own_s += seconds
            return
        top.partial.own_s += seconds
        if top.partial.kind and self._within is None:
            top.partial.whole_s += seconds
        if top.frame is None or not top.from_offset <= top.frame.f_lasti <= top.to_offset:
            top.partial = None

    def _enter_function(self, frame: FrameType) -> None:
        code = frame.f_code
        if code not in self._functions:
            own, module = self._own(code.co_filename), frame.f_globals.get("__name__", "")
            short = code.co_qualname if own else f"{module}.{code.co_qualname}"
            self._functions[code] = _public(short), own
        name, own = self._functions[code]
        calls = self._of(name, own, frame if own else self._open[-1].nearest, frame.f_back)
        if own:
            calls.line = code.co_firstlineno
        self._enter(_Open(calls, frame, frame if own else self._open[-1].nearest))

    def _enter(self, opened: _Open) -> None:
        calls = opened.calls
        calls.count += 1
        if calls.kind and self._within is None:
            calls.whole_count += 1
            self._within, opened.began = calls, self.seconds
        elif calls.kind and self._within is not None and not self._within.inside:
            self._within.inside = calls.name
        self._open.append(opened)

    def _close(self) -> _Open:
        closed = self._open.pop()
        if closed.began >= 0:
            closed.calls.whole_s += self.seconds - closed.began
            self._within = None
        return closed

    def _leave_function(self, frame: FrameType, value: Any) -> None:
        if any(each.frame is frame for each in reversed(self._open)):
            while self._close().frame is not frame:
                pass
            self._note_partial(frame, value)

    def _note_partial(self, frame: FrameType, value: Any) -> None:
        """`__getattr__` returned a builtin with arguments bound to it, as PyBullet's `BulletClient` does."""
        if type(value) is not functools.partial or frame.f_code.co_name != "__getattr__":
            return
        caller, top = frame.f_back, self._open[-1]
        if caller is None or top.frame is not caller or not inspect.isbuiltin(value.func):
            return
        top.partial = self._of_builtin(value.func, caller)
        top.partial.count += 1
        if top.partial.kind and self._within is None:
            top.partial.whole_count += 1
        elif top.partial.kind and self._within is not None and not self._within.inside:
            self._within.inside = top.partial.name
        top.from_offset, top.to_offset = caller.f_lasti, _last_offset(caller.f_code, caller.f_lasti)

    def _of_builtin(self, function: Any, caller: FrameType) -> Calls:
        return self._of(_builtin_name(function), False, self._open[-1].nearest, caller)

    def _of(self, name: str, own: bool, nearest: FrameType | None, caller: FrameType | None) -> Calls:
        at = nearest or caller
        if at is not None and at.f_code.co_filename == __file__:
            at = None
        line = 0 if own or at is None else at.f_lineno
        key = name, at.f_code.co_filename if at else "", line
        if key not in self._calls:
            self._calls[key] = Calls(*key, kind=self._kind_of(name, own))
        return self._calls[key]


def merged(calls: Iterable[Calls], seconds: Callable[[Calls], float]) -> list[Calls]:
    """Add up the calls of each function, the slowest first; its place is the one that took longest."""
    totals: dict[str, Calls] = {}
    for each in sorted(calls, key=seconds, reverse=True):
        total = totals.get(each.name)
        if total is None:
            totals[each.name] = dataclasses.replace(each)
            continue
        total.count += each.count
        total.own_s += each.own_s
        total.whole_s += each.whole_s
        total.whole_count += each.whole_count
    return sorted(totals.values(), key=seconds, reverse=True)


def _builtin_name(function: Any) -> str:
    module = getattr(function, "__module__", None)
    if module:
        return _public(f"{module}.{function.__name__}")
    owner = getattr(function, "__self__", getattr(function, "__objclass__", None))
    if owner is None:  # OpenCV's functions do not say where they are from
        known = getattr(sys.modules.get("cv2"), function.__name__, None) is function
        return f"cv2.{function.__name__}" if known else str(function.__name__)
    kind = owner if isinstance(owner, type) else type(owner)
    return _public(f"{kind.__module__}.{kind.__qualname__}.{function.__name__}")


@functools.cache
def _public(name: str) -> str:
    """Leave out private modules: `numpy.linalg._linalg.norm` is `numpy.linalg.norm`, `io.open` is `open`."""
    name = name.replace("<locals>.", "").removeprefix("builtins.").removeprefix("io.")
    *modules, function = name.split(".")
    return ".".join([*(each for each in modules if not each.startswith("_")), function])


@functools.cache
def _last_offset(code: CodeType, offset: int) -> int:
    """Return where the expression ends that begins where the instruction at an offset does: `client.step(...)`."""
    places = list(code.co_positions())
    line, _, column, _ = places[offset // 2]
    return 2 * max(i for i, place in enumerate(places) if i >= offset // 2 and (place[0], place[2]) == (line, column))
