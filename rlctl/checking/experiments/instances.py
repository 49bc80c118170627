"""The experiment `instances`: plays on several instances, alone and side by side."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

from rlctl.checking.differences import COMPARED_STEPS
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import INSTANCES, JudgeHook, experiment
from rlctl.checking.instance import Context, Instance
from rlctl.checking.recording import Recording
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage
from rlctl.environments import registry
from rlctl.environments.bullet_calls import BulletCall, record_calls

judges_bullet_calls = JudgeHook[Sequence[BulletCall]]()
"""Shows the calls of PyBullet that an instance made without naming a client."""
judges_pairs = JudgeHook[tuple[Any, Any]]()
"""Shows the environments of two instances that are played side by side."""


@experiment("instances", INSTANCES, 10, share=10.0, hooks=(judges_bullet_calls, judges_pairs))
def compare_instances(context: Context) -> Iterator[ChildMessage]:
    """Play on three instances: one alone, one after it, and two side by side of which one is closed."""
    progress, budget = context.progress, context.budget
    longest_s = budget.seconds_left / 5

    def begin(instance: Instance, role: str, seed: int) -> Recording:
        progress.phase(role)
        number, steps = seed - FIRST_SEED, COMPARED_STEPS
        return Recording(role, EpisodePlayer(instance, seed, number=number, max_steps=steps, longest_s=longest_s))

    progress.phase("alone")
    with contextlib.suppress(BaseException):  # `build` reports what it raises
        registry.load(context.spec.task)  # and so, usually, PyBullet
    with record_calls(with_results=()) as calls:
        first = context.build()
    with record_calls(with_results=()) as later:  # of a PyBullet that the constructor has imported
        yield from begin(first, "fresh process", FIRST_SEED).run()
        yield from begin(first, "second alone", SECOND_SEED).run()
    yield from first.close()
    yield from judges_bullet_calls.judge(sorted(calls.without_client | later.without_client))

    progress.phase("fresh instance")
    neighbour = context.build()
    yield from begin(neighbour, "fresh instance", FIRST_SEED).run()
    if budget.is_over():
        yield from neighbour.close()
        return

    # From here on each instance has played the same episodes, in the same order, as `first` had.
    progress.phase("interleaved")
    survivor = context.build()
    yield from judges_pairs.judge((survivor.env, neighbour.env))
    pair = begin(survivor, "interleaved", FIRST_SEED), begin(neighbour, "interleaved second", SECOND_SEED)
    progress.phase("interleaved")
    while running := [recording for recording in pair if recording.running]:
        for recording in running:
            recording.advance()
    for recording in pair:
        yield from recording.run()
    recording = begin(survivor, "after close", SECOND_SEED)
    for _ in range(2):
        if recording.running:
            recording.advance()
    progress.phase("close")
    yield from neighbour.close()
    progress.phase("after close")
    yield from recording.run()
    yield from survivor.close()
