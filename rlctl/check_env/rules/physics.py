"""RL8: the physics, as PyBullet has it while the environment runs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any

from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import NotApplicable, NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.rules.known import built, result
from rlctl.check_env.world_results import Excess, Jump, Moment, TopSpeed, World, WorldBody, WorldLink, Worlds

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO

FEWEST_OUTSIDE = 3
"""Fewer steps outside its limits are a blow that the solver has not answered yet."""
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
"""A base is no part of the matter where it has less than this part of the mass."""


def watched(evidence: Evidence) -> list[World]:
    """Return the worlds; raises `NotApplicable` for an environment without any."""
    built(evidence)
    seen = result(evidence, Worlds, "worlds")
    if not seen.worlds:
        raise NotApplicable("no PyBullet world")
    if not seen.resets:
        raise NotJudged("no episode could be watched")
    return seen.worlds


def _place(at: Moment) -> dict[str, Any]:
    return dataclasses.asdict(at)


def _when(at: Moment) -> str:
    return f"at step {at.step}" if at.step else "at reset"


@rule(
    "RL801",
    "no gravity",
    WARNING,
    "Call setGravity(0, 0, -9.81, physicsClientId=self.client) after resetSimulation.",
    needs=("worlds",),
)
def gravity(evidence: Evidence) -> Iterator[Seen]:
    """Gravity is zero although bodies have mass: PyBullet's default, and what resetSimulation goes back to. A policy
    learns for a world that does not exist. Judged only where gravity would change something: an arm that turns about
    upright axes does not need it. Where weightlessness is meant, waive it."""
    for world in watched(evidence):
        heavy = [body for body in world.bodies if body.is_free or (body.joints and _mass(body.links[1:]) > 0)]
        if heavy and not any(world.gravity) and world.weight_matters is not False:
            names = [body.name for body in heavy]
            message = f"gravity is (0, 0, 0), and {_listed(names)} can move"
            yield Seen(message, {"value": world.gravity, "expected": [0.0, 0.0, -9.81], "bodies": names})


def _mass(links: Sequence[WorldLink]) -> float:
    return sum(link.masses[0] for link in links if link.masses)


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


@rule(
    "RL802",
    "robot touches nothing",
    WARNING,
    "Give the model collision shapes, and take back setCollisionFilterGroupMask or setCollisionFilterPair where they "
    "switch off more than was meant.",
    needs=("worlds",),
)
def collisions(evidence: Evidence) -> Iterator[Seen]:
    """No link of the robot collides: a box around all of it touches none. It goes through the floor, through objects
    and through what should stop it, and a policy learns to. Not judged where the world has nothing to touch."""
    for world in watched(evidence):
        robots = [body for body in world.bodies if body.joints]
        # One that collides is the robot; what else has joints may be a marker of the goal.
        if len(robots) == len(world.bodies) or any(link.collides is not False for b in robots for link in b.links):
            continue
        for body in robots:
            shaped = [link.name for link in body.links if link.has_shape]
            why = (
                f"collisions are off for all {len(shaped)} links that have a shape" if shaped else "no link has a shape"
            )
            message = f"{body.name} passes through everything: {why}"
            yield Seen(message, {"body": body.name, "value": 0, "links": len(body.links), "shapes": len(shaped)})


@rule(
    "RL803",
    "bodies inside each other",
    WARNING,
    "Start without overlap (getClosestPoints shows it), take shorter physics steps or more substeps, keep masses "
    "within a factor of 100 of each other, and drive joints with limited forces instead of resetting their state.",
    needs=("worlds",),
)
def penetration(evidence: Evidence) -> Iterator[Seen]:
    """Links stay deep inside each other for steps on end with ordinary actions. The simulation answers with forces
    that no real contact has, and policies find them and live on them."""
    for world in _whole(watched(evidence)):
        thrown = _thrown(world)
        # What is inside each other since the reset and is thrown out is RL807.
        found = [
            each
            for each in world.penetrations
            if each.since > 1 or not any(body in link for body in thrown for link in each.links)
        ]
        for worst in found[:1]:
            more = f"; so are {len(found) - 1} other pairs of links" if len(found) > 1 else ""
            yield Seen(
                f"{worst.links[0]} is {100 * worst.depth:.1f} cm inside {worst.links[1]} {_when(worst.at)}, and deeper "
                f"than {100 * worst.limit:.1f} cm for {worst.steps} steps in a row{more}",
                {**_place(worst.at), "value": worst.depth, "expected": worst.limit, "links": worst.links},
            )


@rule(
    "RL804",
    "joint beyond its limits",
    WARNING,
    "Clip motor targets to the limits of getJointInfo, draw initial positions inside them, and limit the motors' "
    "force: PyBullet's limits are springs, not walls, and resetJointState does not know them.",
    needs=("worlds",),
)
def joint_limits(evidence: Evidence) -> Iterator[Seen]:
    """A joint is far outside the limits that its model declares. The real one ends there."""
    for world in _whole(watched(evidence)):
        lasting = [each for each in world.excesses if each.steps >= FEWEST_OUTSIDE]
        for body in dict.fromkeys(each.body for each in lasting):
            yield _outside([each for each in lasting if each.body == body])


def _outside(excesses: Sequence[Excess]) -> Seen:
    found, others = excesses[0], [each.joint for each in excesses[1:]]
    unit = "rad" if found.is_angle else "m"
    more = f"; so {'are' if len(others) > 1 else 'is'} {_listed(others)}" if others else ""
    return Seen(
        f"{found.joint} of {found.body} is at {found.value:.3g} {unit} {_when(found.at)}; its limits are "
        f"[{found.low:.3g}, {found.high:.3g}] {unit}; it is outside by much in {found.steps} steps{more}",
        {
            **_place(found.at),
            "joint": found.joint,
            "value": found.value,
            "expected": [found.low, found.high],
            "other_joints": others,
        },
    )


def _whole(worlds: Sequence[World]) -> Iterator[World]:
    """Yield the worlds that stay together; raises `NotJudged` where one explodes, which explains what else is odd."""
    for world in worlds:
        if any(_explodes(each) for each in world.speeds):
            raise NotJudged("the simulation explodes (RL805)")
        yield world


@rule(
    "RL805",
    "simulation explodes",
    WARNING,
    "Take shorter physics steps, limit the motors' force and speed (changeDynamics maxJointVelocity), and look for "
    "links without inertia, overlapping shapes and forces that are applied without a bound.",
    needs=("worlds",),
)
def explosion(evidence: Evidence) -> Iterator[Seen]:
    """Speeds reach what no robot does, or positions are no numbers: the simulation has come apart, and what is
    learned there is about the solver, not about the robot."""
    for world in watched(evidence):
        wrong = [each for each in world.speeds if _explodes(each)]
        for found in sorted(wrong, key=_speed, reverse=True)[:1]:  # the others are its consequence
            part = f"{found.joint} of {found.body}" if found.joint else found.body
            if isinstance(found.value, str):
                message = f"the state of {part} is {found.value} {_when(found.at)}"
            else:
                message = f"{part} moves at {found.value:.4g} {found.kind} {_when(found.at)}"
            more = f", and {len(wrong) - 1} more" if len(wrong) > 1 else ""
            expected = "finite" if isinstance(found.value, str) else _fastest(found)
            yield Seen(message + more, {**_place(found.at), "value": found.value, "expected": expected})


def _speed(found: TopSpeed) -> float:
    return found.value if isinstance(found.value, float) else math.inf


def _fastest(found: TopSpeed) -> float:
    if found.kind == "rad/s":
        return FASTEST_JOINT
    return FASTEST_SLIDE if found.joint else FASTEST_BASE


def _explodes(found: TopSpeed) -> bool:
    if found.at.actions == "extreme" and not isinstance(found.value, str):
        return False
    speed = _speed(found)
    if found.kind == "rad/s" and FASTEST_MEANT < speed < NONSENSE:
        return False
    return speed > _fastest(found)


@rule(
    "RL807",
    "not at rest at reset",
    WARNING,
    "Place bodies without overlap and just above what they stand on; reset velocities and motor targets too, which "
    "resetJointState and restoreState leave as they were.",
    needs=("worlds",),
)
def unstable_reset(evidence: Evidence) -> Iterator[Seen]:
    """Right after a reset, with nothing done to it, a free body is thrown away or drops from a height. Episodes then
    begin with an accident. A drop is only worth knowing; some tasks mean it."""
    for world in watched(evidence):
        thrown = _thrown(world)
        for jump in thrown.values():
            yield Seen(
                f"{jump.body} moves at {jump.speed:.2f} m/s {jump.after_s:.2g} s after reset, with nothing done to it; "
                f"falling explains {jump.explained:.2f} m/s",
                {"seed": jump.seed, "body": jump.body, "value": jump.speed, "expected": jump.explained},
            )
        for fall in world.falls:
            if fall.height > HIGHEST_DROP and fall.body not in thrown:
                message = f"{fall.body} drops {100 * fall.height:.0f} cm after reset before it touches anything"
                yield Seen(message, {**_place(fall.at), "value": fall.height, "expected": HIGHEST_DROP}, INFO)


def _thrown(world: World) -> dict[str, Jump]:
    """Return the bodies that are thrown away right after a reset."""
    wild = [jump for jump in world.jumps if jump.speed > jump.explained + FASTEST_JUMP]
    return {jump.body: jump for jump in reversed(wild)}


@rule(
    "RL806",
    "randomisation without effect",
    WARNING,
    "Change the links that count: those with a collision shape for friction, and range(-1, getNumJoints(...)) for "
    "mass, because -1 is the base.",
    needs=("worlds",),
)
def randomisation(evidence: Evidence) -> Iterator[Seen]:
    """Friction changes from reset to reset on links that touch nothing, or mass on all links but the base. The policy
    is not made robust against what was meant. And a fixed base that is given a mass is fixed no longer."""
    worlds = watched(evidence)
    if result(evidence, Worlds, "worlds").resets < 2:
        raise NotJudged("fewer than 2 resets were watched")
    for world in worlds:
        for body in world.bodies:
            yield from _friction(body)
            yield from _base_mass(body)


def _friction(body: WorldBody) -> Iterator[Seen]:
    changed = [link for link in body.links if _varies(link.frictions)]
    if changed and all(link.has_shape is False or link.collides is False for link in changed):
        names = [link.name for link in changed]
        low, high = min(min(link.frictions) for link in changed), max(max(link.frictions) for link in changed)
        yield Seen(
            f"the friction of {_listed(names)} of {body.name} varies from {low:.3g} to {high:.3g}, and touches nothing",
            {"body": body.name, "links": names, "value": [low, high]},
        )


def _base_mass(body: WorldBody) -> Iterator[Seen]:
    base, others = body.links[0], [link for link in body.links[1:] if _mass([link]) > 0]
    if base.mass_built == 0 and any(base.masses):
        message = f"the base of {body.name} was fixed (mass 0) and got a mass of {max(base.masses):.3g} kg: it can fall"
        yield Seen(message, {"body": body.name, "value": max(base.masses), "expected": 0.0})
        return
    skips = len(others) >= FEWEST_LINKS and all(_varies(link.masses) for link in others) and not _varies(base.masses)
    if skips and body.is_free and _mass([base]) > LIGHTEST_BASE * _mass(body.links):
        part = _mass([base]) / _mass(body.links)
        message = (
            f"the masses of all {len(others)} links of {body.name} vary, but not that of the base, "
            f"{_mass([base]):.3g} kg and {part:.0%} of all"
        )
        yield Seen(message, {"body": body.name, "link": base.name, "value": _mass([base]), "links": len(others)})


def _varies(values: Sequence[float]) -> bool:
    return max(values, default=0.0) - min(values, default=0.0) > SAME * max(map(abs, values), default=0.0)
