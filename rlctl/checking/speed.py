"""How fast an environment is, and which of its calls take the time."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rlctl.checking.profiling import TimedCall
from rlctl.checking.records import Records
from rlctl.checking.rule import NotJudged
from rlctl.output import format_duration

MILLION = 1_000_000
SLOW_LOADING_S = 0.005  # [s]; resetSimulation of an empty world takes a tenth of this
MOST_LOADING = 0.2  # share of a step from which loading there is a finding
LEAST_DRAWING = 0.05  # share of a step or reset; less is a `render` that returns at once
SMALLEST_IMAGE = 8  # two axes at least this long are an image [pixels]
NAMED_CALLS = 3
LEAST_SHARE = 0.01  # Calls that take less are not named among the slowest


@dataclasses.dataclass(frozen=True)
class Speed:
    """How long steps and resets take, and what takes that long."""

    step_s: float | None  # with a random action [s]; None if none was timed
    reset_s: float | None
    steps: int  # How many were timed
    resets: int
    slowest_in_step: list[TimedCall]  # by their own time, the slowest first
    suspicious_in_step: list[TimedCall]  # with what they call; none is inside another
    suspicious_in_reset: list[TimedCall]
    rebuilds: bool  # a task of rlctl that declares slow resets
    is_batch: bool = False  # a `BatchTask`: one of its worlds was timed


def format_speed(records: Records) -> str:
    """Return what a report says about speed in a line; empty where nothing was timed."""
    try:
        speed, step_s, reset_s, steps = require_times(records)
    except NotJudged:
        return ""
    episode_s = reset_s + steps * step_s
    per_s = float(f"{steps / episode_s:.2g}")
    calls = f"; slowest: {list_calls(speed.slowest_in_step)}" if speed.slowest_in_step else ""
    alone = "; this is one world alone, those of a batch are several times faster" if speed.is_batch else ""
    return (
        f"step {format_time(step_s)}, reset {format_time(reset_s)} ({reset_s / episode_s:.1%} of an episode), "
        f"{per_s:,.{0 if per_s >= 10 else 1}f} steps/s: a million steps take {format_duration(MILLION / per_s)}{calls}"
        f"{alone}"
    )


def require_times(records: Records) -> tuple[Speed, float, float, float]:
    """Return the speed, the time of a step and of a reset [s], and the steps of an episode."""
    speed: Speed = records.require_fact("speed")
    episodes = [episode for episode in records.role("episodes") if episode.steps]
    whole = [episode for episode in episodes if episode.has_ended] or episodes
    random = [episode for episode in whole if episode.actions == "random"] or whole
    if not speed.step_s or speed.reset_s is None or not random:
        raise NotJudged("too few steps or resets to measure their time")
    return speed, speed.step_s, speed.reset_s, float(np.mean([episode.steps for episode in random]))


def _suspicious(speed: Speed, call: str, kinds: Sequence[str]) -> list[TimedCall]:
    calls = speed.suspicious_in_step if call == "step" else speed.suspicious_in_reset
    return [call for call in calls if call.kind in kinds]


def find_idle(records: Records, speed: Speed, call: str) -> list[TimedCall]:
    """Return the calls in step or reset that draw or sleep, and that nobody asked for."""
    shapes = [leaf.shape for leaf in records.require_built().leaves]
    has_image = any(sum(size >= SMALLEST_IMAGE for size in shape) >= 2 for shape in shapes)
    kinds = ("sleeping",) if has_image else ("sleeping", "rendering")
    return [timed for timed in _suspicious(speed, call, kinds) if timed.share >= LEAST_DRAWING]


def find_loading(speed: Speed, call: str) -> list[TimedCall]:
    """Return the calls in step or reset that load or connect, if they take much of its time."""
    if call == "reset" and speed.rebuilds:
        return []
    calls = _suspicious(speed, call, ("loading", "connecting"))
    share = add_shares(calls)
    seconds = share * ((speed.step_s if call == "step" else speed.reset_s) or 0.0)
    is_much = seconds > SLOW_LOADING_S or (call == "step" and share > MOST_LOADING)
    return calls if is_much or any(call.kind == "connecting" for call in calls) else []


def add_shares(calls: Sequence[TimedCall]) -> float:
    """Return which part of the time some calls take together."""
    return min(1.0, sum(call.share for call in calls))


def list_calls(calls: Sequence[TimedCall]) -> str:
    """Name the first calls, with their shares and places."""
    named = [call for call in calls[:NAMED_CALLS] if call.share >= LEAST_SHARE]
    return ", ".join(f"{call.name} {call.share:.0%}{name_call_place(call)}" for call in named)


def name_call_place(call: TimedCall) -> str:
    """Return where a call is, in brackets; empty where that is not known."""
    return f" ({call.place})" if call.place else ""


def format_time(seconds: float) -> str:
    """Write a time with its unit."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e6:.3g} us"
