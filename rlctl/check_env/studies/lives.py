"""A few dozen short lives of an environment, written down.

`comparisons` and `episodes` live on a single instance; `instances` builds three, in another process with another
hash seed, to see whether a new process, a new instance or a neighbour changes anything.
"""

from __future__ import annotations

from collections.abc import Iterator

from rlctl.check_env.context import Context
from rlctl.check_env.evidence import FIRST_SEED, SECOND_SEED
from rlctl.check_env.instance import Instance
from rlctl.check_env.legacy import skip
from rlctl.check_env.messages import Message
from rlctl.check_env.recording import Plan, Recording

EPISODES = [
    *("random", "zero", "extreme", "random", "random", "random"),
    *("extreme", "zero", "random", "random", "extreme", "random", "extreme", "random"),
    *("repeated", "repeated"),
]
"""How the actions of each episode are chosen; the first three come first, in case time runs out."""
COMPARED_STEPS = 300
"""How far comparisons look. The first of them is also the probe's first whole episode."""
DIRTY_STEPS = 37
"""How far the other episode goes, at most, that is left unfinished before a repetition."""
ENDLESS_STEPS = 10_000
"""After so many steps an episode without an end is cut."""
LATER_ENDLESS_STEPS = 1_000
"""The same, once every kind of action was tried."""
MAX_FAILURES = 3


def comparisons(context: Context) -> Iterator[Message]:
    """Live the first episode again: at once, after an unfinished other one, and with another seed."""
    instance, budget = context.instance, context.budget
    longest_s = budget.seconds_left / 4
    steps = COMPARED_STEPS
    for number, role in enumerate(("alone", "reused", "dirty", "seeds")):
        if role == "dirty":
            instance.progress.phase("dirty")
            unfinished = min(DIRTY_STEPS, max(1, steps // 2))
            other = Plan(role, 0, SECOND_SEED, "extreme", max_steps=unfinished, max_s=1.0)
            Recording(instance, other, budget).run()
        instance.progress.phase(role)
        if budget.seconds_left < 0:
            yield skip(role, "the first comparisons took all the time there is for them")
            continue
        seed = SECOND_SEED if role == "seeds" else FIRST_SEED
        plan = Plan(role, number, seed, "random", FIRST_SEED, COMPARED_STEPS, longest_s)
        recording = Recording(instance, plan, budget)
        yield from recording.run()
        steps = min(steps, recording.steps)
    for number, role in enumerate(("unseeded", "unseeded again")):
        if budget.seconds_left < 0:
            yield skip(role, "the first comparisons took all the time there is for them")
            continue
        plan = Plan(role, number, FIRST_SEED, max_steps=0, then_unseeded=True)
        yield from Recording(instance, plan, budget).run()


def episodes(context: Context) -> Iterator[Message]:
    """Live whole episodes with actions of every kind."""
    instance, budget = context.instance, context.budget
    failures = cut = 0
    for number, kind in enumerate(EPISODES):
        if budget.seconds_left < 0 or budget.bytes_left < 0:
            what = "time" if budget.seconds_left < 0 else "memory"
            yield skip("episodes", f"{number} of {len(EPISODES)} episodes were lived in the {what} there is")
            break
        plan = Plan(
            "episodes",
            number,
            FIRST_SEED + number,
            kind,
            max_steps=LATER_ENDLESS_STEPS if number >= 3 and cut else ENDLESS_STEPS,
            max_s=budget.seconds_left / 2,
        )
        recording = Recording(instance, plan, budget)
        yield from recording.run()
        cut += recording.was_cut
        failures += recording.failure is not None
        if failures >= MAX_FAILURES:
            yield skip("episodes", f"stopped after {MAX_FAILURES} episodes that raised")
            break


def instances(context: Context) -> Iterator[Message]:
    """Live on three instances: one alone, one after it, and two side by side of which one is closed."""
    progress, budget = context.progress, context.budget
    longest_s = budget.seconds_left / 5

    def live(instance: Instance, role: str, seed: int) -> Recording:
        plan = Plan(role, seed - FIRST_SEED, seed, max_steps=COMPARED_STEPS, max_s=longest_s)
        return Recording(instance, plan, budget)

    progress.phase("alone")
    first = context.build()
    yield from live(first, "fresh process", FIRST_SEED).run()
    yield from live(first, "second alone", SECOND_SEED).run()
    yield from context.close(first)

    progress.phase("fresh instance")
    neighbour = context.build()
    yield from live(neighbour, "fresh instance", FIRST_SEED).run()
    if budget.seconds_left < 0:
        for role in ("interleaved", "after close"):
            yield skip(role, "building and stepping the first two instances took all the time there is for them")
        yield from context.close(neighbour)
        return

    # From here on each instance has lived the same episodes, in the same order, as `first` had.
    progress.phase("interleaved")
    survivor = context.build()
    yield from _interleaved(live(survivor, "interleaved", FIRST_SEED), live(neighbour, "interleaved", SECOND_SEED))
    progress.phase("after close")
    last = live(survivor, "after close", SECOND_SEED)
    last.reset()
    if last.running:
        last.step()
    progress.phase("close")
    yield from context.close(neighbour)
    progress.phase("after close")
    while last.running:
        last.step()
    yield from last.messages()
    yield from context.close(survivor)


def _interleaved(*recordings: Recording) -> Iterator[Message]:
    for recording in recordings:
        recording.reset()
    while any(recording.running for recording in recordings):
        for recording in recordings:
            if recording.running:
                recording.step()
    for recording in recordings:
        yield from recording.messages()
