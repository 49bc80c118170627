"""RL9: speed. Training takes millions of steps; what each of them costs decides what can be tried at all."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence

from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.results import Speed, TimedCall
from rlctl.check_env.rules.known import built, result

WARNING, INFO = Severity.WARNING, Severity.INFO

MILLION = 1_000_000
SLOW_STEPS_PER_S = 100.0
"""Below it a million steps, a small training, take about three hours on one core [steps/s]."""
SLOW_RESET_S = 0.005
"""A reset, or loading in it, below this is not worth a word, whatever its share of short episodes: PyBullet's
resetSimulation of an empty world alone takes half a millisecond [s]."""
MOST_RESET = 0.5
"""Share of an episode that reset takes from which most of training is spent in reset."""
LITTLE_LOADING = 0.05
"""Share of an episode below which loading in reset for more than `SLOW_RESET_S` is only worth knowing: environments
that are stepped together wait for the one that resets, but rarely."""
MOST_LOADING = 0.2
"""Share of a step that loading or reading files takes from which that is worth the work to change."""
LEAST_DRAWING = 0.05
"""Share of a step, or of a reset, below which drawing and waiting are not worth a word: a `render` that returns at
once because there is nothing to show."""
SMALLEST_IMAGE = 8
"""An observation with two axes at least this long is an image, so a camera is part of the task [pixels]."""
NAMED_CALLS = 3
LEAST_SHARE = 0.01
"""Calls that take less are not named among the slowest."""

IDLE = ("rendering", "sleeping")
LOADING = ("loading", "connecting")
NEEDS = ("speed", "episodes")


@rule(
    "RL901",
    "slow",
    WARNING,
    "Begin with the call named first. In a simulation: fewer or longer substeps, simpler collision shapes, fewer "
    "solver iterations, no self-collision that is not needed; in Python: one call for all joints instead of one each.",
    needs=("speed",),
)
def slow(evidence: Evidence) -> Iterator[Seen]:
    """A million steps, which is a small training, take more than about three hours per process. More environments in
    parallel help as far as there are cores; a faster step helps everywhere. Time that RL903 and RL904 name is left
    out here."""
    speed = _speed(evidence)
    if speed.step_s is None:
        raise NotJudged("no step could be timed")
    left = speed.step_s * (1 - _share(_explained(evidence, speed, "step")))
    if left * SLOW_STEPS_PER_S <= 1:
        return
    per_s, hours = 1 / speed.step_s, MILLION * speed.step_s / 3600
    calls = _slowest(speed.slowest_in_step)
    yield Seen(
        f"{per_s:,.3g} steps/s: a million steps take {hours:,.3g} hours per process on this machine; slowest: {calls}",
        {"value": per_s, "expected": SLOW_STEPS_PER_S, "step_ms": 1e3 * speed.step_s, "steps": speed.steps},
    )


@rule(
    "RL902",
    "reset takes most of the time",
    WARNING,
    "Do what is the same for every episode once, in __init__; in a simulation restore a state saved right after "
    "loading (saveState, restoreState).",
    needs=NEEDS,
)
def slow_reset(evidence: Evidence) -> Iterator[Seen]:
    """More than half of the time of an episode, as long as they are with random actions, goes into its reset: most
    of a training is spent there. Where loading or waiting in reset is the reason, RL903 and RL904 say so instead. For
    a task of rlctl with fast_reset = False that is the price of exact repetition, and only worth knowing."""
    speed, steps = _speed(evidence), episode_steps(evidence)
    if speed.step_s is None or speed.reset_s is None or steps is None:
        raise NotJudged("no step or no reset could be timed")
    left = speed.reset_s * (1 - _share(_explained(evidence, speed, "reset")))
    if left <= SLOW_RESET_S or left / (left + steps * speed.step_s) <= MOST_RESET:
        return
    share = _reset_share(speed, steps)
    yield Seen(
        f"reset takes {_time(speed.reset_s)}, {share:.0%} of an episode of {steps:.0f} steps of {_time(speed.step_s)} "
        f"each; slowest: {_slowest(speed.slowest_in_reset)}",
        {"value": share, "expected": MOST_RESET, "reset_ms": 1e3 * speed.reset_s, "steps": steps},
        INFO if speed.rebuilds else None,
        "If every episode repeats exactly without it (RL303), set fast_reset = True." if speed.rebuilds else None,
    )


@rule(
    "RL903",
    "draws or waits unasked",
    WARNING,
    'Render only in render(), and call that from step only if render_mode is "human"; sleep only there, to show the '
    "simulation in real time.",
    needs=("speed",),
)
def draws(evidence: Evidence) -> Iterator[Seen]:
    """step or reset renders, draws or sleeps although no render mode was asked for: nobody sees it, and every step
    pays for it. Rendering is fine where the observation has an image."""
    speed = _speed(evidence)
    for call, seconds in (("step", speed.step_s), ("reset", speed.reset_s)):
        for each in _idle(evidence, _suspicious(speed, call)):
            lost = _time(each.share * seconds) if seconds else "?"
            inside = f", there {each.inside}" if each.inside else ""
            yield Seen(
                f"{call} calls {each.name}{_at(each)}{inside}: {lost} per {call}, {each.share:.0%} of its time",
                {"call": call, "value": each.name, "place": each.place, "share": each.share},
            )


@rule(
    "RL904",
    "loads in reset or step",
    WARNING,
    "Connect and load once, in __init__; in reset restore a state saved right after loading (saveState, "
    "restoreState), or set back what step changes.",
    needs=NEEDS,
)
def loads(evidence: Evidence) -> Iterator[Seen]:
    """reset, or even step, loads models, reads files or connects to a simulator anew, and that takes a good part of
    an episode. A world that is loaded once and restored resets a hundred times faster. A new connection per reset is
    named whatever it takes: what step and other methods hold of the old one is void, and a client that is not
    disconnected stays. A task of rlctl with fast_reset = False loads in reset because it must."""
    speed, steps = _speed(evidence), episode_steps(evidence)
    if speed.reset_s is None or speed.step_s is None or steps is None:
        raise NotJudged("no step or no reset could be timed")
    episode_s = speed.reset_s + steps * speed.step_s
    for call, seconds, whole_s in (("reset", speed.reset_s, episode_s), ("step", speed.step_s, speed.step_s)):
        if calls := _loading(speed, call):
            yield _loads(call, calls, seconds * _share(calls), whole_s)


def _loads(call: str, calls: Sequence[TimedCall], seconds: float, whole_s: float) -> Seen:
    share = seconds / whole_s if whole_s else 0.0
    connects = any(each.kind == "connecting" for each in calls)
    named = sorted(calls, key=lambda each: (each.kind != "connecting", -each.share))
    more = f" and {len(named) - NAMED_CALLS} more" if len(named) > NAMED_CALLS else ""
    part = "an episode" if call == "reset" else "its time"
    return Seen(
        f"{call} calls {', '.join(f'{each.name}{_at(each)}' for each in named[:NAMED_CALLS])}{more}: "
        f"{_time(seconds)} per {call}, {share:.0%} of {part}",
        {"call": call, "value": [each.name for each in named], "ms": 1e3 * seconds, "share": share},
        INFO if call == "reset" and not connects and share < LITTLE_LOADING else None,
    )


def speed_line(evidence: Evidence) -> str:
    """Return what a report says about speed in a line; empty where nothing was timed."""
    speed, steps = evidence.facts.get(Speed.__name__), episode_steps(evidence)
    if not isinstance(speed, Speed) or not speed.step_s or speed.reset_s is None or steps is None:
        return ""
    per_s = float(f"{steps / (speed.reset_s + steps * speed.step_s):.2g}")
    calls = f"; slowest: {_slowest(speed.slowest_in_step)}" if speed.slowest_in_step else ""
    return (
        f"step {_time(speed.step_s)}, reset {_time(speed.reset_s)} ({_reset_share(speed, steps):.1%} of an episode), "
        f"{per_s:,.{0 if per_s >= 10 else 1}f} steps/s: a million steps take {_duration(MILLION / per_s)}{calls}"
    )


def episode_steps(evidence: Evidence) -> float | None:
    """Return the mean length of an episode with random actions, or of any, cut ones only if there are no others."""
    lived = [each for each in evidence.episodes if each.steps]
    whole = [each for each in lived if each.has_ended] or lived
    random = [each for each in whole if each.actions == "random"] or whole
    return statistics.fmean(each.steps for each in random) if random else None


def _speed(evidence: Evidence) -> Speed:
    return result(evidence, Speed, "speed")


def _suspicious(speed: Speed, call: str) -> list[TimedCall]:
    return speed.suspicious_in_step if call == "step" else speed.suspicious_in_reset


def _idle(evidence: Evidence, calls: Sequence[TimedCall]) -> list[TimedCall]:
    """Return the calls that RL903 finds."""
    shapes = [leaf.shape for leaf in built(evidence).leaves]
    sees = any(sum(size >= SMALLEST_IMAGE for size in shape) >= 2 for shape in shapes)
    kinds = [kind for kind in IDLE if not (sees and kind == "rendering")]
    return [each for each in calls if each.kind in kinds and each.share >= LEAST_DRAWING]


def _loading(speed: Speed, call: str) -> list[TimedCall]:
    """Return the calls that RL904 finds."""
    if call == "reset" and speed.rebuilds:
        return []
    calls = [each for each in _suspicious(speed, call) if each.kind in LOADING]
    connects = any(each.kind == "connecting" for each in calls)
    share = _share(calls)
    seconds = share * ((speed.step_s if call == "step" else speed.reset_s) or 0.0)
    too_much = seconds > SLOW_RESET_S or (call == "step" and share > MOST_LOADING)
    return calls if connects or too_much else []


def _explained(evidence: Evidence, speed: Speed, call: str) -> list[TimedCall]:
    """Return the calls whose time RL903 or RL904 names."""
    return _idle(evidence, _suspicious(speed, call)) + _loading(speed, call)


def _share(calls: Sequence[TimedCall]) -> float:
    return min(1.0, sum(each.share for each in calls))


def _reset_share(speed: Speed, steps: float) -> float:
    step_s, reset_s = speed.step_s or 0.0, speed.reset_s or 0.0
    return reset_s / (reset_s + steps * step_s)


def _slowest(calls: Sequence[TimedCall]) -> str:
    return ", ".join(
        f"{each.name} {each.share:.0%}{_at(each)}" for each in calls[:NAMED_CALLS] if each.share >= LEAST_SHARE
    )


def _at(call: TimedCall) -> str:
    return f" ({call.place})" if call.place else ""


def _time(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e6:.3g} us"


def _duration(seconds: float) -> str:
    for unit, size in (("days", 86400.0), ("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} seconds"
