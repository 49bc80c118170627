"""RL014: event without effect."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from rlctl.checking.experiments.variants import TaskVariants, judges_variants, play_variant
from rlctl.checking.instance import Context, EnvironmentRaised
from rlctl.checking.records import ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.task.body import Body
from rlctl.task.events import Event
from rlctl.task.events.event import Widening

RULE = Rule(
    "RL014",
    "event without effect",
    Severity.WARNING,
    meaning="""
        An event of a task draws numbers and reports them, but changes nothing with them: what it calls in the world
        is the same for other numbers, and so is an episode with its ranges at both ends. Or its interval is longer than
        an episode, so that it never acts. The policy is trained without this randomisation.
    """,
    fix="""
        Apply what the event's function draws, such as sim.body('arm').scale_mass(drawn); let every_s be a part of
        episode_s.
    """,
)

MOMENTS = ("reset", "start", "interval")  # of events that change the world
PLAIN = (str, float, bool, np.ndarray, np.floating)
"""What is read of a body to compute with; more than that, such as an id, may be used to change the engine itself."""


@dataclasses.dataclass
class SpiedCalls:
    """What an event's function did with the world."""

    calls: list[str] = dataclasses.field(default_factory=list)
    is_complete: bool = True  # False if it got at something whose use cannot be seen


class Spy:
    """Stands for a world or a body, and notes what is called."""

    def __init__(self, target: Any, noted: SpiedCalls) -> None:
        self.__dict__.update(_target=target, _noted=noted)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._target, name)
        if not callable(value):
            self._noted.is_complete &= _is_plain(value)
            return value.copy() if isinstance(value, np.ndarray) else value

        def call(*arguments: Any, **keywords: Any) -> Any:
            self._noted.calls.append(_describe((name, arguments, keywords)))
            result = value(*arguments, **keywords)
            return Spy(result, self._noted) if isinstance(result, Body) else result

        return call

    def __setattr__(self, name: str, value: Any) -> None:
        self._noted.is_complete = False
        setattr(self._target, name, value)


def _describe(value: Any) -> str:
    """Return a text that is equal for equal arguments; arrays are written with all of their digits."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}{value.tobytes().hex()}"
    if isinstance(value, tuple | list):
        return f"({', '.join(map(_describe, value))})"
    if isinstance(value, dict):
        return f"({', '.join(f'{name}: {_describe(part)}' for name, part in value.items())})"
    return repr(value)


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple | list):
        return all(isinstance(part, PLAIN) for part in value)
    return isinstance(value, PLAIN)


@judges_variants(RULE)
def _find_idle_events(variants: TaskVariants) -> Iterator[ChildMessage]:
    if not variants.task.events:
        yield Skipped(RULE.id, "the task has no events", applies=False)
        return
    yield from _find_late_events(variants)
    if not variants.repeats:
        yield Skipped(RULE.id, "equal seeds and actions give unequal episodes (RL3)")
        return
    events = {name: event for name, event in variants.task.events.items() if event.when in MOMENTS}
    try:
        with variants.context.fresh() as instance:
            instance.reset(0)
            sim = instance.env.unwrapped.sim
            idle = [name for name, event in events.items() if _is_idle(name, event, sim)]
        for name in idle:
            ranges = _find_ranges(name, events[name])
            if ranges and _are_ends_equal(variants.context, name, ranges):
                message = f"event {name!r} draws {', '.join(ranges)} and changes nothing with it"
                yield RuleFinding(RULE, message, {"element": f"events.{name}"})
    except EnvironmentRaised:  # RL011 plays all events
        yield Skipped(RULE.id, "an event raises (RL011)")


def _find_late_events(variants: TaskVariants) -> Iterator[RuleFinding]:
    """Yield the events at an interval that is longer than an episode."""
    episode_s = variants.task.episode_s
    for name, event in variants.task.events.items():
        changed = variants.context.spec.events.get(name)
        every_s = changed.get("every_s", event.every_s) if isinstance(changed, Mapping) else event.every_s
        if event.when == "interval" and every_s >= episode_s:
            message = f"event {name!r} acts every {every_s:g} s, and an episode lasts {episode_s:g} s: it never acts"
            evidence = {"element": f"events.{name}", "value": every_s, "expected": f"below {episode_s:g}"}
            yield RuleFinding(RULE, message, evidence)


def _is_idle(name: str, event: Event, sim: Any) -> bool:
    """Say whether an event does the same with the world whatever it draws."""
    seen = []
    for seed in (0, 1):
        noted = SpiedCalls()
        try:
            drawn = event.bind(name)(Spy(sim, noted), np.random.default_rng(seed), 1.0)
        except Exception:  # RL011 plays it; or it needs more than a spy has
            return False
        if not noted.is_complete:
            return False
        seen.append((drawn, noted.calls))
    (first, first_calls), (second, second_calls) = seen
    return bool(first != second and first_calls == second_calls)


def _find_ranges(name: str, event: Event) -> dict[str, tuple[float, float]]:
    """Return the ranges from which an event draws different numbers, by parameter."""
    values: Mapping[str, Any] = event.bind(name).values
    ends = {key: value.end for key, value in values.items() if isinstance(value, Widening)}
    return {key: (low, high) for key, (low, high) in ends.items() if low < high}


def _are_ends_equal(context: Context, name: str, ranges: Mapping[str, tuple[float, float]]) -> bool:
    """Say whether an episode is the same to the last bit with the ranges of an event at both ends."""
    episodes = []
    for end in (0, 1):
        changed = {key: [ends[end]] * 2 for key, ends in ranges.items()}
        spec = dataclasses.replace(context.spec, events={**context.spec.events, name: changed})
        with context.fresh(spec=spec) as instance:
            episodes.append(play_variant(instance))
    at_low, at_high = episodes
    return bool(np.array_equal(at_low, at_high))
