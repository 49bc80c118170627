"""The experiment `speed`: measures the time of steps and resets, and what takes it."""

import cProfile
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.instance import Context, Instance, Timer
from rlctl.checking.profiling import Profile, Stopwatch, find_own_code
from rlctl.checking.progress import read_clock
from rlctl.checking.records import ChildMessage, Fact
from rlctl.checking.speed import Speed
from rlctl.checking.values import find_author, find_batch, is_task
from rlctl.environments.bullet_calls import visible_to_profilers

FIRST_SPEED_SEED = 5000
TIMED_STEPS, TIMED_RESETS = 200, 5
PROFILED_S, MOST_STEPS = 0.15, 2_000  # How long steps are profiled, and resets [s]; so many are enough
BATCH = 25  # steps per mean; the median of the means ignores disturbances
LONGEST_S = 2.0  # enough, however much there is [s]


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
