"""RL014: event without effect."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.bullet_worlds import read_states, read_world
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiments.variants import STEPS, TaskVariants, judges_variants
from rlctl.checking.instance import EnvironmentRaised, Instance
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.values import flatten
from rlctl.environments.simulations import find_mujoco
from rlctl.task.body import Body
from rlctl.task.events import Event
from rlctl.task.events.event import Widening

RULE = Rule(
    "RL014",
    "event without effect",
    Severity.WARNING,
    meaning="""
        An event of a task draws numbers and reports them, but changes nothing with them: what it calls in the world
        is the same for other numbers, and so is an episode with its ranges at both ends. Or it pushes a part, or
        changes its mass, that is fixed to the world: episodes with its ranges at both ends are the same to the last bit
        although the robot moves. Or its interval is longer than an episode, so that it never acts. The policy is
        trained without this randomisation.
    """,
    fix="""
        Apply what the event's function draws, such as sim.body('arm').scale_mass(drawn); name a link that moves, since
        without one a push acts on the base; let every_s be a part of episode_s.
    """,
)

FELT = ("push", "scale_mass")
"""Calls that change how a body moves which is not fixed: a force at once, and a mass of a robot whose joints move."""
EARLY = 0.2  # part of a played variant after which an event acts that has an interval
MOMENTS = ("reset", "start", "interval")  # of events that change the world
PLAIN = (str, float, bool, np.ndarray, np.floating)
"""What is read of a body to compute with; more than that, such as an id, may be used to change the engine itself."""


@dataclasses.dataclass
class SpiedCalls:
    """What an event's function did with the world."""

    calls: list[str] = dataclasses.field(default_factory=list)
    names: set[str] = dataclasses.field(default_factory=set)  # of the same calls
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
            self._noted.names.add(name)
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
            spied = {name: _spy(name, event, sim) for name, event in events.items()}
        for name, seen in spied.items():
            ranges = _find_ranges(name, events[name])
            if not ranges or not (seen.is_idle or seen.is_felt):
                continue
            if _are_ends_equal(variants, name, ranges, needs_motion=not seen.is_idle):
                message = f"event {name!r} draws {', '.join(ranges)} and changes nothing with it"
                if not seen.is_idle:
                    message = f"event {name!r} changes nothing: with {', '.join(ranges)} at both ends of the range, the"
                    message += " same actions give the same episode to the last bit, although the robot moves"
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


@dataclasses.dataclass(frozen=True)
class _SpiedEvent:
    is_idle: bool = False  # Whether it does the same with the world whatever it draws
    is_felt: bool = False  # Whether what it draws changes how a body moves that is not fixed


def _spy(name: str, event: Event, sim: Any) -> _SpiedEvent:
    seen = []
    for seed in (0, 1):
        noted = SpiedCalls()
        try:
            drawn = event.bind(name)(Spy(sim, noted), np.random.default_rng(seed), 1.0)
        except Exception:  # RL011 plays it; or it needs more than a spy has
            return _SpiedEvent()
        if not noted.is_complete:
            return _SpiedEvent()
        seen.append((drawn, noted))
    (first, one), (second, two) = seen
    differs = one.calls != two.calls
    return _SpiedEvent(bool(first != second and not differs), differs and not one.names.isdisjoint(FELT))


def _find_ranges(name: str, event: Event) -> dict[str, tuple[float, float]]:
    """Return the ranges from which an event draws different numbers, by parameter."""
    values: Mapping[str, Any] = event.bind(name).values
    ends = {key: value.end for key, value in values.items() if isinstance(value, Widening)}
    return {key: (low, high) for key, (low, high) in ends.items() if low < high}


def _are_ends_equal(
    variants: TaskVariants, name: str, ranges: Mapping[str, tuple[float, float]], *, needs_motion: bool
) -> bool:
    """Say whether an episode is the same to the last bit with the ranges of an event at both ends."""
    episodes, event = [], variants.task.events[name]
    early_s = EARLY * STEPS * variants.task.control_dt
    more = {"every_s": min(event.every_s, early_s)} if event.when == "interval" else {}
    for end in (0, 1):
        changed = {key: [ends[end]] * 2 for key, ends in ranges.items()}
        spec = variants.context.spec
        spec = dataclasses.replace(spec, events={**spec.events, name: {**changed, **more}})
        with variants.context.fresh(spec=spec) as instance:
            episodes.append(_play(instance))
    (at_low, moves), (at_high, _) = episodes
    return np.array_equal(at_low, at_high) and (moves or not needs_motion)


def _play(instance: Instance) -> tuple[NDArray[np.float64], bool]:
    """Return the observations and the states of joints of an episode, one after the other, and whether the joints
    moved in the later part of it, when events at an interval have acted."""
    rows, joints = [np.zeros(0)], []
    for moment in EpisodePlayer(instance, FIRST_SEED, max_steps=STEPS):
        joints.append(_read_joints(instance))
        rows += [flatten(moment.observation), joints[-1]]
    later = joints[len(joints) // 2 :]
    moves = len(joints) > STEPS and all(not np.array_equal(one, later[0]) for one in later[1:])
    return np.concatenate(rows), moves


def _read_joints(instance: Instance) -> NDArray[np.float64]:
    if (simulation := find_mujoco(instance.env)) is not None:
        return np.concatenate([simulation[1].qpos, simulation[1].qvel])
    clients = instance.find_clients()
    return np.concatenate([np.zeros(0), *(state for one in clients for state in read_states(read_world(one)))])
