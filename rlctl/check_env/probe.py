"""The probe: a few dozen short lives of an environment, whose record all rules share.

Two parts run in two processes at once. `probe` lives on a single instance; `instances` builds three, with another
hash seed, to see whether a new process, a new instance or a neighbour changes anything. Both yield messages, each
as soon as it is known, so that what comes before a crash is not lost.
"""

from __future__ import annotations

import inspect
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

from rlctl.check_env.evidence import FIRST_SEED, SECOND_SEED
from rlctl.check_env.failures import EnvironmentRaised, describe, failure
from rlctl.check_env.leaves import leaf_to_wire, leaves_of
from rlctl.check_env.progress import Progress
from rlctl.check_env.recording import Budget, Instance, Plan, Recording
from rlctl.check_env.wire import Message
from rlctl.errors import TaskError

Make = Callable[[], Any]

EPISODES = [
    *("random", "zero", "extreme", "random", "random", "random"),
    *("extreme", "zero", "random", "random", "extreme", "random", "extreme", "random"),
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
EPISODES_S, COMPARISONS_S, INSTANCES_S = 8.0, 8.0, 14.0
"""Time for the whole episodes, the comparisons on one instance, and those between instances [s]."""
MAX_FAILURES = 3


def probe(make: Make, progress: Progress | None = None) -> Iterator[Message]:
    """Live on one instance: one episode again and again, then whole episodes of several kinds."""
    progress = progress or Progress()
    env = make()
    instance = _instance(env, progress)
    yield _built(env, instance)
    if not _can_act(env):
        yield _skip("episodes", "its action space is no Gymnasium space")
        return
    yield from _comparisons(instance)
    yield from _episodes(instance)
    progress.phase("close")
    yield from _closed(instance)


def _comparisons(instance: Instance) -> Iterator[Message]:
    """The first episode lived again: at once, after an unfinished other one, and with another seed."""
    budget = Budget(time.monotonic() + COMPARISONS_S)
    steps = COMPARED_STEPS
    for number, role in enumerate(("alone", "reused", "dirty", "seeds")):
        if role == "dirty":
            instance.progress.phase("dirty")
            unfinished = min(DIRTY_STEPS, max(1, steps // 2))
            other = Plan(role, 0, SECOND_SEED, "extreme", max_steps=unfinished, max_s=1.0)
            Recording(instance, other, budget).run()
        instance.progress.phase(role)
        if budget.seconds_left < 0:
            yield _skip(role, f"the first comparisons took {COMPARISONS_S:g} s")
            continue
        seed = SECOND_SEED if role == "seeds" else FIRST_SEED
        plan = Plan(role, number, seed, "random", FIRST_SEED, COMPARED_STEPS, COMPARISONS_S / 4)
        recording = Recording(instance, plan, budget)
        yield from recording.run()
        steps = min(steps, recording.steps)
    for number, role in enumerate(("unseeded", "unseeded again")):
        plan = Plan(role, number, FIRST_SEED, max_steps=0, then_unseeded=True)
        yield from Recording(instance, plan, budget).run()


def _episodes(instance: Instance) -> Iterator[Message]:
    instance.progress.phase("episodes")
    budget = Budget(time.monotonic() + EPISODES_S)
    failures = cut = 0
    for number, kind in enumerate(EPISODES):
        if budget.seconds_left < 0 or budget.bytes_left < 0:
            what = "time" if budget.seconds_left < 0 else "memory"
            yield _skip("episodes", f"{number} of {len(EPISODES)} episodes were lived in the {what} there is")
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
            yield _skip("episodes", f"stopped after {MAX_FAILURES} episodes that raised")
            break


def instances(make: Make, progress: Progress | None = None) -> Iterator[Message]:
    """Live on three instances: one alone, one after it, and two side by side of which one is closed."""
    progress = progress or Progress()
    try:
        yield from _instances(make, progress)
    except EnvironmentRaised as error:
        yield failure(error, progress), {}


def _instances(make: Make, progress: Progress) -> Iterator[Message]:
    budget = Budget(time.monotonic() + INSTANCES_S)

    def live(instance: Instance, role: str, seed: int) -> Recording:
        plan = Plan(role, seed - FIRST_SEED, seed, max_steps=COMPARED_STEPS, max_s=INSTANCES_S / 5)
        return Recording(instance, plan, budget)

    progress.phase("alone")
    first = _build(make, progress)
    if not _can_act(first.env):
        return
    yield from live(first, "fresh process", FIRST_SEED).run()
    yield from live(first, "second alone", SECOND_SEED).run()
    yield from _closed(first)

    progress.phase("fresh instance")
    neighbour = _build(make, progress)
    yield from live(neighbour, "fresh instance", FIRST_SEED).run()
    if budget.seconds_left < 0:
        for role in ("interleaved", "after close"):
            yield _skip(role, f"building and stepping took {INSTANCES_S:g} s")
        return

    # From here on each instance has lived the same episodes, in the same order, as `first` had.
    progress.phase("interleaved")
    survivor = _build(make, progress)
    yield from _interleaved(live(survivor, "interleaved", FIRST_SEED), live(neighbour, "interleaved", SECOND_SEED))
    progress.phase("after close")
    last = live(survivor, "after close", SECOND_SEED)
    last.reset()
    if last.running:
        last.step()
    progress.phase("close")
    yield from _closed(neighbour)
    progress.phase("after close")
    while last.running:
        last.step()
    yield from last.messages()
    yield from _closed(survivor)


def _interleaved(*recordings: Recording) -> Iterator[Message]:
    for recording in recordings:
        recording.reset()
    while any(recording.running for recording in recordings):
        for recording in recordings:
            if recording.running:
                recording.step()
    for recording in recordings:
        yield from recording.messages()


def _build(make: Make, progress: Progress) -> Instance:
    try:
        return _instance(make(), progress)
    except BaseException as error:
        raise EnvironmentRaised("build") from error


def _instance(env: Any, progress: Progress) -> Instance:
    try:
        observation_space = getattr(env, "observation_space", None)
    except Exception as error:
        raise TaskError(f"observation_space raises {describe(error)}") from error
    return Instance(env, leaves_of(observation_space), _accepts_seed(env), progress)


def _closed(instance: Instance) -> Iterator[Message]:
    if not hasattr(instance.env, "close"):
        return
    try:
        instance.close()
    except EnvironmentRaised as error:
        yield failure(error, instance.progress), {}


def _accepts_seed(env: Any) -> bool:
    try:
        parameters = inspect.signature(env.reset).parameters.values()
    except ValueError:  # not written in Python
        return True
    return any(each.name == "seed" or each.kind is each.VAR_KEYWORD for each in parameters)


def _can_act(env: Any) -> bool:
    from gymnasium import spaces

    return isinstance(env.action_space, spaces.Space)


def _skip(role: str, reason: str) -> Message:
    return {"type": "skipped", "role": role, "reason": reason}, {}


def _built(env: Any, instance: Instance) -> Message:
    import gymnasium

    inner = getattr(env, "unwrapped", env)
    spec = getattr(env, "spec", None)
    task_env = sys.modules.get("rlctl.task.env")
    is_task = task_env is not None and isinstance(inner, task_env.TaskEnv)
    parts = {"leaves": instance.leaves, "action_leaves": leaves_of(env.action_space)}
    header = {
        "type": "built",
        **{name: [leaf_to_wire(leaf) for leaf in leaves] for name, leaves in parts.items()},
        "observation_space": _short(getattr(env, "observation_space", None)),
        "action_space": _short(env.action_space),
        "names": dict(inner.observation_sizes) if is_task else {},
        "max_steps": inner.max_steps if is_task else getattr(spec, "max_episode_steps", None),
        "nondeterministic": bool(getattr(spec, "nondeterministic", False)),
        "accepts_seed": instance.accepts_seed,
        "is_env": isinstance(env, gymnasium.Env),
    }
    arrays = {}
    for name, leaves in parts.items():
        for i, leaf in enumerate(leaves):
            if leaf.low is not None and leaf.high is not None:
                arrays[f"{name}/{i}/low"], arrays[f"{name}/{i}/high"] = leaf.low, leaf.high
    return header, arrays


def _short(space: Any) -> str:
    text = " ".join(str(space).split())
    if len(text) <= 100:
        return text
    shape = getattr(space, "shape", None)
    return f"{type(space).__name__}{shape or ''}"
