"""RL706: action moves hardly anything."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.episode import EpisodePlayer, action_at
from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.instance import EnvironmentRaised
from rlctl.checking.motor_commands import CommandSpan
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import JOINTS, Array, Joint

RULE = Rule(
    "RL706",
    "action moves hardly anything",
    Severity.WARNING,
    meaning="""
        The check played the same episode with the whole action at its lowest and at its highest value. Each joint
        ended within 1 % of its range of where it is with the other action; or all actions drive the motors over
        less than 1.5 % of their control range. The robot hardly moves, whatever a policy does. Most often an
        action between -1 and 1 is scaled twice, or by a factor that was meant for other units.
    """,
    fix="Let the ends of the action space be the ends of what the motors may do, or a good part of it.",
)

FIRST_STEPS, STEPS = 12, 100  # that are played of a robot that moves, and of one that has not done so by then
HARDLY_MOVED, HARDLY_DRIVEN = 0.01, 0.015  # parts of the joint's range, and of the motor's
FULL_TURN, SLIDE = 2 * np.pi, 0.2  # the ranges of joints without limits [rad], [m]


@dataclasses.dataclass(frozen=True)
class _Moved:
    """How far the ends of the action bring a joint apart."""

    joint: Joint
    distance: float  # [rad], [m]

    @property
    def range(self) -> float:
        """That of the joint [rad], [m]."""
        if self.joint.has_limits:
            return self.joint.high - self.joint.low
        return FULL_TURN if self.joint.is_angle else SLIDE

    @property
    def part(self) -> float:
        """Part of the range."""
        return self.distance / self.range


@judges_worlds(RULE, place=91)
def _find_weak_actions(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    """Yield a finding where the ends of the action bring no joint apart, or hardly change what motors get."""
    if watched.low.size == 0 or not watched.instance.accepts_seed:
        return
    driven = [span for _, spans in watched.driven for span in spans if np.isfinite(span.motor.high - span.motor.low)]
    if driven and all(_find_part(span) < HARDLY_DRIVEN for span in driven):
        yield _describe_spans(driven)
        return
    if not any(body.joints for world in watched.worlds for body in world.world.bodies):
        return
    try:
        moved = _compare_ends(watched)
    except EnvironmentRaised:  # an episode that was logged raised it too
        return
    if moved and max(one.part for one in moved) < HARDLY_MOVED:
        yield _describe_moved(moved)


def _find_part(span: CommandSpan) -> float:
    return (span.high - span.low) / (span.motor.high - span.motor.low)


def _describe_spans(driven: Sequence[CommandSpan]) -> RuleFinding:
    widest = max(driven, key=_find_part)
    motor = widest.motor
    spans = f"[{widest.low:.4g}, {widest.high:.4g}] of [{motor.low:.4g}, {motor.high:.4g}]"
    most = f"at most {100 * _find_part(widest):.2g} % of their control range"
    message = f"all actions drive the motors over {most}: {motor.name} over {spans}"
    return RuleFinding(RULE, message, {"element": motor.name, "value": [widest.low, widest.high]})


def _describe_moved(moved: Sequence[_Moved]) -> RuleFinding:
    widest = max(moved, key=lambda one: one.part)
    unit = "rad" if widest.joint.is_angle else "m"
    what = f"joint {widest.joint.name} by {widest.distance:.3g} of {widest.range:.3g} {unit}"
    most = f"no joint ends further apart than {100 * widest.part:.2g} % of its range ({what})"
    message = f"with the action at its lowest and at its highest value, held for up to {STEPS} steps, {most}"
    evidence = {"element": widest.joint.name, "seed": FIRST_SEED, "value": widest.distance, "steps": STEPS}
    return RuleFinding(RULE, message, evidence)


def _compare_ends(watched: WatchedWorlds) -> list[_Moved]:
    """Return how far the joints end apart with the lowest and the highest action; empty where that is not known."""
    for steps in (FIRST_STEPS, STEPS):
        if watched.instance.context.budget.is_over():
            return []
        low, high = (_play(watched, end, steps) for end in (0.0, 1.0))
        moved = [_Moved(joint, distance) for joint, distance in _measure(watched.worlds, low, high)]
        if not moved or max(one.part for one in moved) >= HARDLY_MOVED:
            return []
    return moved


def _play(watched: WatchedWorlds, end: float, steps: int) -> list[list[Array]]:
    """Play an episode with the action at one end; return the states of all bodies of each world after each step."""
    instance = watched.instance
    action = action_at(instance.env.action_space, np.full(watched.low.size, end))
    player = EpisodePlayer(instance, FIRST_SEED, "held", max_steps=steps, sequence=itertools.repeat(action))
    states: list[list[Array]] = []
    for moment in player:
        if moment.step:
            states.append([state for world in watched.worlds for state in _read(world)])
    return states


def _read(world: LoggedWorld) -> list[Array]:
    reader = world.reader
    try:
        reader.update()
        return reader.read_states()
    except reader.errors:
        return []


def _measure(
    worlds: Sequence[LoggedWorld], low: Sequence[Sequence[Array]], high: Sequence[Sequence[Array]]
) -> Iterator[tuple[Joint, float]]:
    """Yield the largest difference of each joint at any step."""
    bodies = [body for world in worlds for body in world.reader.world.bodies]
    pairs = [(a, b) for a, b in zip(low, high, strict=False) if len(a) == len(b) == len(bodies)]
    if not pairs:
        return
    for number, body in enumerate(bodies):
        columns = slice(JOINTS, JOINTS + len(body.joints))
        apart = np.max([np.abs(a[number] - b[number])[columns] for a, b in pairs], axis=0, initial=0.0)
        yield from zip(body.joints, np.nan_to_num(apart, nan=np.inf).tolist(), strict=True)
