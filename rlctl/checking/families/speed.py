"""RL9: speed. Training takes millions of steps; the time of each decides what can be trained."""

import cProfile
import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment, judges_records
from rlctl.checking.instance import Context, Instance, Timer
from rlctl.checking.profiling import Profile, Stopwatch, TimedCall, find_own_code
from rlctl.checking.progress import read_clock
from rlctl.checking.records import ChildMessage, Fact, Records
from rlctl.checking.rule import NotJudged, RuleFinding, Severity, list_names
from rlctl.checking.values import find_author, find_batch, is_task
from rlctl.environments.bullet_calls import visible_to_profilers
from rlctl.output import format_duration

FIRST_SPEED_SEED = 5000
TIMED_STEPS, TIMED_RESETS = 200, 5
PROFILED_S, MOST_STEPS = 0.15, 20_000  # How long steps are profiled, and resets [s]; so many are enough
BATCH = 25  # steps per mean; the median of the means ignores disturbances
LONGEST_S = 2.0  # enough, however much there is [s]
MILLION = 1_000_000
SLOW_STEPS_PER_S = 100.0  # a million steps then take about three hours [steps/s]
CLEARLY_SLOW = 1.25  # So many times slower than that is a warning; less may be a busy machine
LARGE_CALL = 0.25  # share of a step; where no call takes so much, a slow step is an info: there is no place to begin
SLOW_LOADING_S = 0.005  # [s]; resetSimulation of an empty world takes a tenth of this
LITTLE_LOADING = 0.05  # Share of an episode below which loading in reset is not reported
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


@experiment("speed", PROBE, 40, share=1.5)
def measure_speed(context: Context) -> Iterator[ChildMessage]:
    """Play random episodes: first with nothing but a clock, then under a profiler."""
    instance, seconds = context.instance, min(LONGEST_S, context.budget.seconds_left)
    steps, resets = Stopwatch(), Stopwatch()
    stopwatches = {"step": steps, "reset": resets}
    _play(instance, stopwatches, TIMED_STEPS, seconds / 2)
    _play(instance, stopwatches, TIMED_RESETS, seconds / 4, only_reset=True)
    profilers = {"step": cProfile.Profile(), "reset": cProfile.Profile()}
    timers = {call: profiler.runcall for call, profiler in profilers.items()}
    with visible_to_profilers():
        for only_reset in (False, True):
            _play(instance, timers, MOST_STEPS, min(seconds / 4, PROFILED_S), only_reset=only_reset)
    context.budget.was_cut = False  # it lasts as long as it should
    is_own = find_own_code(instance.env)
    in_step, in_reset = (Profile(profiler, is_own) for profiler in profilers.values())
    speed = Speed(
        step_s=typical(steps.seconds, BATCH),
        reset_s=typical(resets.seconds, 1),
        steps=len(steps.seconds),
        resets=len(resets.seconds),
        slowest_in_step=in_step.slowest()[:5],
        suspicious_in_step=in_step.suspicious(),
        suspicious_in_reset=in_reset.suspicious(),
        rebuilds=is_task(instance.env) and not find_author(instance.env).fast_reset,
        is_batch=find_batch(instance.env) is not None,
    )
    yield Fact("speed", speed)


def _play(
    instance: Instance, timers: Mapping[str, Timer], calls: int, longest_s: float, *, only_reset: bool = False
) -> None:
    instance.timers = timers
    number, deadline = 0, read_clock() + longest_s
    try:
        while calls > 0 and (left_s := deadline - read_clock()) > 0:
            steps = 0 if only_reset else calls
            seed = FIRST_SPEED_SEED + number
            episode = EpisodePlayer(instance, seed, number=number, max_steps=steps, longest_s=left_s)
            for _ in episode:
                pass
            number += 1
            calls -= max(1, episode.steps)
    finally:
        instance.timers = {}


def typical(seconds: Sequence[float], batch: int) -> float | None:
    """Return the median of the means of batches; those left over count only where there is no whole one."""
    if not seconds:
        return None
    batch = min(batch, len(seconds))
    whole = np.reshape(seconds[: len(seconds) // batch * batch], (-1, batch))
    return float(np.median(whole.mean(axis=1)))


@judges_records("RL901", "speed")
def _find_slow_step(records: Records) -> Iterator[RuleFinding]:
    speed: Speed = records.require_fact("speed")
    if speed.step_s is None:
        raise NotJudged("no step could be timed")
    named_elsewhere = _idle(records, speed, "step") + _loading(speed, "step")
    left = speed.step_s * (1 - _share(named_elsewhere))
    if left * SLOW_STEPS_PER_S <= 1:
        return
    per_s, hours, slowest = 1 / speed.step_s, MILLION * speed.step_s / 3600, _list(speed.slowest_in_step)
    time = f"a million steps take {hours:,.3g} hours per process on this machine"
    evidence = {"value": per_s, "expected": SLOW_STEPS_PER_S, "step_ms": 1e3 * speed.step_s, "steps": speed.steps}
    is_clear = left * SLOW_STEPS_PER_S > CLEARLY_SLOW
    has_large_call = any(call.share >= LARGE_CALL for call in speed.slowest_in_step)
    severity = Severity.WARNING if is_clear and has_large_call else Severity.INFO
    yield RuleFinding("RL901", f"{per_s:,.3g} steps/s: {time}; slowest: {slowest}", evidence, severity)


@judges_records("RL903", "speed")
def _find_drawing_and_waiting(records: Records) -> Iterator[RuleFinding]:
    speed: Speed = records.require_fact("speed")
    for call, seconds in (("step", speed.step_s), ("reset", speed.reset_s)):
        for timed in _idle(records, speed, call):
            lost = _time(timed.share * seconds) if seconds else "?"
            message = f"{call} calls {timed.name}{_at(timed)}: {lost} per {call}, {timed.share:.0%} of its time"
            evidence = {"call": call, "value": timed.name, "place": timed.place, "share": timed.share}
            yield RuleFinding("RL903", message, evidence)


@judges_records("RL904", "speed", "episodes")
def _find_loading(records: Records) -> Iterator[RuleFinding]:
    speed, step_s, reset_s, steps = _require_times(records)
    for call, call_s, part, whole_s in (
        ("reset", reset_s, "an episode", reset_s + steps * step_s),
        ("step", step_s, "its time", step_s),
    ):
        calls = _loading(speed, call)
        seconds = call_s * _share(calls)
        share = seconds / whole_s if whole_s else 0.0
        connects = any(call.kind == "connecting" for call in calls)
        if calls and (connects or call == "step" or share >= LITTLE_LOADING):
            named = sorted(calls, key=lambda call: (call.kind != "connecting", -call.share))
            names = list_names([f"{timed.name}{_at(timed)}" for timed in named], NAMED_CALLS)
            message = f"{call} calls {names}: {_time(seconds)} per {call}, {share:.0%} of {part}"
            evidence = {"call": call, "value": [timed.name for timed in named], "ms": 1e3 * seconds, "share": share}
            severity = Severity.WARNING if share >= LITTLE_LOADING else Severity.INFO
            yield RuleFinding("RL904", message, evidence, severity)


def format_speed(records: Records) -> str:
    """Return what a report says about speed in a line; empty where nothing was timed."""
    try:
        speed, step_s, reset_s, steps = _require_times(records)
    except NotJudged:
        return ""
    episode_s = reset_s + steps * step_s
    per_s = float(f"{steps / episode_s:.2g}")
    calls = f"; slowest: {_list(speed.slowest_in_step)}" if speed.slowest_in_step else ""
    alone = "; this is one world alone, those of a batch are several times faster" if speed.is_batch else ""
    return (
        f"step {_time(step_s)}, reset {_time(reset_s)} ({reset_s / episode_s:.1%} of an episode), "
        f"{per_s:,.{0 if per_s >= 10 else 1}f} steps/s: a million steps take {format_duration(MILLION / per_s)}{calls}"
        f"{alone}"
    )


def _require_times(records: Records) -> tuple[Speed, float, float, float]:
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


def _idle(records: Records, speed: Speed, call: str) -> list[TimedCall]:
    shapes = [leaf.shape for leaf in records.require_built().leaves]
    has_image = any(sum(size >= SMALLEST_IMAGE for size in shape) >= 2 for shape in shapes)
    kinds = ("sleeping",) if has_image else ("sleeping", "rendering")
    return [timed for timed in _suspicious(speed, call, kinds) if timed.share >= LEAST_DRAWING]


def _loading(speed: Speed, call: str) -> list[TimedCall]:
    if call == "reset" and speed.rebuilds:
        return []
    calls = _suspicious(speed, call, ("loading", "connecting"))
    share = _share(calls)
    seconds = share * ((speed.step_s if call == "step" else speed.reset_s) or 0.0)
    is_much = seconds > SLOW_LOADING_S or (call == "step" and share > MOST_LOADING)
    return calls if is_much or any(call.kind == "connecting" for call in calls) else []


def _share(calls: Sequence[TimedCall]) -> float:
    return min(1.0, sum(call.share for call in calls))


def _list(calls: Sequence[TimedCall]) -> str:
    named = [call for call in calls[:NAMED_CALLS] if call.share >= LEAST_SHARE]
    return ", ".join(f"{call.name} {call.share:.0%}{_at(call)}" for call in named)


def _at(call: TimedCall) -> str:
    return f" ({call.place})" if call.place else ""


def _time(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e6:.3g} us"
