"""RL8: the physics, as PyBullet has it while the environment runs."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.bullet_clients import connected
from rlctl.check_env.bullet_worlds import Joint, Pair
from rlctl.check_env.client_calls import find_left_out, record_calls
from rlctl.check_env.context import Context
from rlctl.check_env.experiment import experiment
from rlctl.check_env.failures import EnvironmentRaised, failure
from rlctl.check_env.finding import Finding, NotApplicable, NotJudged, Severity, list_names
from rlctl.check_env.messages import Message, Skipped
from rlctl.check_env.world_logs import Log, LoggedWorld, Place, WorldLogger
from rlctl.check_env.world_tests import Jump

EPISODES = (("zero", 50), ("random", 60), ("random", 60), ("extreme", 50), ("random", 60))
"""The actions of each episode, and how many of its steps are logged."""
LASTING_STEPS = 3
"""What lasts for fewer steps is a blow that the solver has not answered yet."""
PART_OF_RANGE, LEAST_ANGLE, LEAST_LENGTH = 0.1, 0.05, 0.01
"""How far outside its limits a joint may be: part of the range, and at least so much [rad], [m]."""
FASTEST_BASE = 50.0
"""[m/s]; PyBullet itself stops at 100 along each axis, and no robot or thing that it handles is faster than a car."""
FASTEST_JOINT = 90.0
"""[rad/s]; PyBullet itself stops at 100. Arms and legs stay below 30, also when they fall or are thrown about."""
FASTEST_SLIDE = 50.0  # [m/s]
FASTEST_MEANT = 100.5
"""Beyond its own limit of 100 somebody has raised it, as for propellers and wheels; then only nonsense counts."""
NONSENSE = 5_000.0
FASTEST_JUMP = 1.0
"""So much faster than by falling a body may be a tenth of a second after a reset [m/s]: ten times gravity."""
HIGHEST_DROP = 0.1  # [m]
SAME = 1e-9
"""Relative difference up to which masses and frictions are equal."""
FEWEST_LINKS = 2
LIGHTEST_BASE = 0.05
"""A base does not matter where it has less than this part of the mass."""
MOST_NAMES = 3


@experiment("worlds", *(f"RL80{i}" for i in range(1, 9)), share=4.0)
def watch_worlds(context: Context) -> Iterator[Message]:
    """Log the worlds of an instance through a few episodes. What changes them (falling alone, boxes) comes after."""
    older = set(connected())
    with record_calls() as calls, context.fresh() as instance:
        logger = WorldLogger(instance, older)
        for number, (kind, steps) in enumerate(EPISODES):
            if number and (context.budget.seconds_left < 0 or not logger.worlds):
                break
            try:
                logger.play(number, kind, steps, context.budget.deadline)
            except EnvironmentRaised as error:
                yield failure(error, context.progress)
        if logger.worlds and context.budget.seconds_left > 0:
            with contextlib.suppress(EnvironmentRaised):  # its resets were logged by now
                logger.let_go(len(EPISODES), context.budget.deadline)
        worlds = logger.finish()
        if not logger.resets:
            raise NotJudged("no episode could be logged")
        if not worlds:
            raise NotApplicable("no PyBullet world")
        yield from find_left_out(instance.env, dict(calls))
    for world in worlds:
        yield from _judge(world)
    if logger.resets < 2:
        yield Skipped("RL806", "fewer than 2 resets were logged")


def _judge(world: LoggedWorld) -> Iterator[Message]:
    yield from _gravity(world)
    yield from _collisions(world)
    explosions = list(_explosion(world))
    yield from explosions
    if explosions:
        for rule in ("RL803", "RL804"):
            yield Skipped(rule, "the simulation explodes (RL805)")  # which explains what else is odd
    else:
        yield from _penetration(world)
        yield from _joint_limits(world)
    yield from _unrest(world)
    for i in range(len(world.world.bodies)):
        yield from _friction(world, i)
        yield from _base_mass(world, i)


def _when(place: Place) -> str:
    return f"at step {place['step']}" if place["step"] else "at reset"


def _gravity(world: LoggedWorld) -> Iterator[Finding]:
    masses = [each.masses for each in world.dynamics[0]]
    bodies = zip(world.world.bodies, masses, strict=True)
    heavy = [body.name for body, mass in bodies if body.is_free or (body.joints and sum(mass[1:]) > 0)]
    if heavy and not any(world.gravity) and world.weight_matters is not False:
        evidence = {"value": world.gravity, "expected": [0.0, 0.0, -9.81], "bodies": heavy}
        yield Finding("RL801", f"gravity is (0, 0, 0), and {list_names(heavy, MOST_NAMES)} can move", evidence)


def _collisions(world: LoggedWorld) -> Iterator[Finding]:
    bodies = world.world.bodies
    robots = [(body, touch) for body, touch in zip(bodies, world.touches, strict=True) if body.joints]
    # One that collides is the robot; what else has joints may be a marker of the goal.
    if len(robots) == len(bodies) or not all(touch for _, touch in robots):
        return
    if any(link.collides for _, touch in robots for link in touch.values()):
        return
    for body, touch in robots:
        shapes = sum(link.has_shape for link in touch.values())
        why = f"collisions are off for all {shapes} links that have a shape" if shapes else "no link has a shape"
        evidence = {"body": body.name, "value": 0, "links": len(body.links), "shapes": shapes}
        yield Finding("RL802", f"{body.name} passes through everything: {why}", evidence)


def _penetration(world: LoggedWorld) -> Iterator[Finding]:
    """Yield what is deep inside something else for several steps in a row with ordinary actions, the deepest only."""
    thrown = _thrown(world)
    worst: dict[Pair, tuple[float, Log, list[int]]] = {}
    for log in world.logs:
        for pair in {pair for deep in log.deep for pair in deep} if log.actions != "extreme" else ():
            row = _longest_row([pair in deep for deep in log.deep])
            depth = max(log.deep[i][pair][0] for i in row)
            names = [log.world.link_name(link) for link in pair]
            # What is inside each other since the reset and is thrown out is RL807.
            is_thrown = log.places[row[0]]["step"] <= 1 and any(body in name for body in thrown for name in names)
            if len(row) >= LASTING_STEPS and not is_thrown and depth > worst.get(pair, (0.0,))[0]:
                worst[pair] = depth, log, row
    for pair, (depth, log, row) in sorted(worst.items(), key=lambda each: -each[1][0])[:1]:
        at = max(row, key=lambda i: log.deep[i][pair][0])
        limit, place = log.deep[at][pair][1], log.places[at]
        names = [log.world.link_name(link) for link in pair]
        more = f"; so are {len(worst) - 1} other pairs of links" if len(worst) > 1 else ""
        yield Finding(
            "RL803",
            f"{names[0]} is {100 * depth:.1f} cm inside {names[1]} {_when(place)}, and deeper than "
            f"{100 * limit:.1f} cm for {len(row)} steps in a row{more}",
            {**place, "value": depth, "expected": limit, "links": names},
        )


def _longest_row(is_deep: Sequence[bool]) -> list[int]:
    row: list[int] = []
    longest: list[int] = []
    for i, each in enumerate(is_deep):
        row = [*row, i] if each else []
        longest = row if len(row) > len(longest) else longest
    return longest


def _joint_limits(world: LoggedWorld) -> Iterator[Finding]:
    worst: dict[str, dict[str, tuple[float, int, Place, float, Joint]]] = {}
    for log in world.logs:
        for i, body in enumerate(log.world.bodies) if log.states else ():
            found, positions = worst.setdefault(body.name, {}), log.series(i, "joints")[:, 0]
            for j, joint in enumerate(body.joints):
                outside = _outside(joint, positions[:, j])
                steps, row = int((outside > 0).sum()), int(outside.argmax())
                if steps >= LASTING_STEPS and outside[row] > found.get(joint.name, (0.0,))[0]:
                    found[joint.name] = float(outside[row]), steps, log.places[row], float(positions[row, j]), joint
    for name, found in worst.items():
        ordered = sorted(found.values(), key=lambda each: -each[0])
        for _, steps, place, value, joint in ordered[:1]:
            others = [each[-1].name for each in ordered[1:]]
            unit = "rad" if joint.is_angle else "m"
            more = f"; so {'are' if len(others) > 1 else 'is'} {list_names(others, MOST_NAMES)}" if others else ""
            limits = [joint.low, joint.high]
            yield Finding(
                "RL804",
                f"{joint.name} of {name} is at {value:.3g} {unit} {_when(place)}; its limits are [{limits[0]:.3g}, "
                f"{limits[1]:.3g}] {unit}; it is outside by much in {steps} steps{more}",
                {**place, "joint": joint.name, "value": value, "expected": limits, "other_joints": others},
            )


def _outside(joint: Joint, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far a joint is outside its limits, in parts of their width; 0 where that is little."""
    if not joint.has_limits:
        return np.zeros(len(values))
    width = joint.high - joint.low
    allowed = max(PART_OF_RANGE * width, LEAST_ANGLE if joint.is_angle else LEAST_LENGTH)
    outside = np.maximum(joint.low - values, values - joint.high)
    return np.where(np.isfinite(outside) & (outside > allowed), outside / width, 0.0)


@dataclasses.dataclass(frozen=True)
class _TopSpeed:
    """The highest speed of something that lasted."""

    part: str
    unit: str
    speed: float
    """Infinite where its state has a number that is not finite."""
    limit: float
    place: Place
    value: float | str

    @property
    def explodes(self) -> bool:
        """Whether it is beyond what robots do."""
        if math.isinf(self.speed):
            return True
        is_meant = self.unit == "rad/s" and FASTEST_MEANT < self.speed < NONSENSE
        return self.speed > self.limit and not is_meant and self.place["actions"] != "extreme"


def _explosion(world: LoggedWorld) -> Iterator[Finding]:
    """Yield the worst of what is faster than any robot, or is not a number."""
    speeds = [each for log in world.logs for each in _speeds(log) if each.explodes]
    speeds.sort(key=lambda each: -each.speed)
    parts = {(each.part, each.unit) for each in speeds}
    for each in speeds[:1]:
        more = f", and {len(parts) - 1} more" if len(parts) > 1 else ""  # its consequences
        if isinstance(each.value, str):
            message, expected = f"the state of {each.part} is {each.value} {_when(each.place)}", "finite"
        else:
            message = f"{each.part} moves at {each.value:.4g} {each.unit} {_when(each.place)}"
            expected = f"up to {each.limit:g}"
        yield Finding("RL805", message + more, {**each.place, "value": each.value, "expected": expected})


def _speeds(log: Log) -> Iterator[_TopSpeed]:
    for i, body in enumerate(log.world.bodies) if log.states else ():
        wrong = np.argwhere(~np.isfinite(log.series(i, "numbers")))
        if wrong.size:
            row, column = wrong[0].tolist()
            value = str(log.states[row][i].numbers[column])
            yield _TopSpeed(body.name, "", math.inf, 0.0, log.places[row], value)
            continue
        linear, angular = (np.linalg.norm(log.series(i, name), axis=1) for name in ("velocity", "angular"))
        parts = [(body.name, "m/s", FASTEST_BASE, linear), (body.name, "rad/s", FASTEST_JOINT, angular)]
        for joint, speeds in zip(body.joints, np.abs(log.series(i, "joints")[:, 1]).T, strict=True):
            unit, limit = ("rad/s", FASTEST_JOINT) if joint.is_angle else ("m/s", FASTEST_SLIDE)
            parts.append((f"{joint.name} of {body.name}", unit, limit, speeds))
        for part, unit, limit, speeds in parts:
            row = int(np.argsort(speeds)[-min(LASTING_STEPS, len(speeds))])
            yield _TopSpeed(part, unit, float(speeds[row]), limit, log.places[row], float(speeds[row]))


def _thrown(world: LoggedWorld) -> dict[str, Jump]:
    """Return the bodies that are thrown away right after a reset."""
    return {jump.body: jump for jump in reversed(world.jumps) if jump.speed > jump.explained + FASTEST_JUMP}


def _unrest(world: LoggedWorld) -> Iterator[Finding]:
    thrown = _thrown(world)
    for jump in thrown.values():
        yield Finding(
            "RL807",
            f"{jump.body} moves at {jump.speed:.2f} m/s {jump.after_s:.2g} s after reset, with nothing done to it; "
            f"falling explains {jump.explained:.2f} m/s",
            {"seed": jump.seed, "body": jump.body, "value": jump.speed, "expected": jump.explained},
        )
    for log in world.logs:
        for i, body in enumerate(log.world.bodies) if log.actions == "zero" else ():
            first = next((row for row, touching in enumerate(log.touching) if body.id in touching), 0)
            heights = np.nan_to_num(log.series(i, "position")[:, 2])
            height = float(heights[0] - heights[first])
            if body.is_free and height > HIGHEST_DROP and body.name not in thrown:
                message = f"{body.name} drops {100 * height:.0f} cm after reset before it touches anything"
                evidence = {**log.places[0], "value": height, "expected": HIGHEST_DROP}
                yield Finding("RL807", message, evidence, Severity.INFO)


def _friction(world: LoggedWorld, i: int) -> Iterator[Finding]:
    body, touches = world.world.bodies[i], world.touches[i]
    frictions = np.array([each[i].frictions for each in world.dynamics])
    changed = [j for j in range(len(body.links)) if _varies(frictions[:, j])]
    if changed and touches and all(not touches[j - 1].collides for j in changed):
        names = [body.links[j] for j in changed]
        low, high = float(frictions[:, changed].min()), float(frictions[:, changed].max())
        what = f"the friction of {list_names(names, MOST_NAMES)} of {body.name} varies from {low:.3g} to {high:.3g}"
        evidence = {"body": body.name, "links": names, "value": [low, high]}
        yield Finding("RL806", f"{what}, and touches nothing", evidence)


def _base_mass(world: LoggedWorld, i: int) -> Iterator[Finding]:
    body, masses = world.world.bodies[i], np.array([each[i].masses for each in world.dynamics])
    first = masses[0]
    if world.built is not None and world.built[i].masses[0] == 0 and masses[:, 0].any():
        mass = float(masses[:, 0].max())
        message = f"the base of {body.name} was fixed (mass 0) and got a mass of {mass:.3g} kg: it can fall"
        yield Finding("RL806", message, {"body": body.name, "value": mass, "expected": 0.0})
        return
    others = [j for j in range(1, len(first)) if first[j] > 0]
    if len(others) < FEWEST_LINKS or not all(_varies(masses[:, j]) for j in others) or _varies(masses[:, 0]):
        return
    if body.is_free and first[0] > LIGHTEST_BASE * first.sum():
        yield Finding(
            "RL806",
            f"the masses of all {len(others)} links of {body.name} vary, but not that of the base, {first[0]:.3g} kg "
            f"and {first[0] / first.sum():.0%} of all",
            {"body": body.name, "link": body.links[0], "value": float(first[0]), "links": len(others)},
        )


def _varies(values: NDArray[np.float64]) -> bool:
    return bool(np.ptp(values) > SAME * np.abs(values).max())
