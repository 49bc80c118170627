"""RL805: simulation explodes."""

import math
from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiments.worlds import judges_logs
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.world_logs import LASTING_STEPS, LoggedWorld, Place, WorldLog, name_place
from rlctl.checking.worlds import ANGULAR, JOINTS, VELOCITY, Array, WorldBody

RULE = Rule(
    "RL805",
    "simulation explodes",
    Severity.WARNING,
    meaning="""
        Speeds are higher than any robot's, positions are not finite, or MuJoCo reports that the simulation is
        unstable: it has diverged, and a policy learns about the solver, not about the robot. MuJoCo then sets
        the state back to the model's first one, in the middle of an episode.
    """,
    fix="""
        Take shorter physics steps, limit the motors' force and speed, and look for links without inertia,
        overlapping shapes and forces without a bound.
    """,
)

FASTEST_BASE = 50.0  # [m/s]; PyBullet stops at 100 per axis, and no robot is faster than a car
FASTEST_JOINT, FASTEST_SLIDE = 90.0, 50.0  # [rad/s], [m/s]; PyBullet stops at 100; arms and legs stay below 30
FASTEST_MEANT, NONSENSE = 100.5, 5_000.0  # between them the author raised the limit, for example for wheels


@judges_logs(RULE)
def _find_explosions(world: LoggedWorld) -> Iterator[RuleFinding]:
    fastest = [record for log in world.logs for body, states in log.bodies for record in _fast(log, body, states)]
    fastest.sort(key=lambda record: -record[0])
    parts = {part for _, part, *_ in fastest}
    failed = [log for log in world.logs if log.failure and log.actions != "extreme"]
    for log in failed[:1]:
        yield RuleFinding(RULE, log.failure, {**log.places[-1], "actions": log.actions})
    for _, _, message, evidence in fastest[:1] if not failed else ():
        more = f", and {len(parts) - 1} more" if len(parts) > 1 else ""  # its consequences
        yield RuleFinding(RULE, message + more, evidence)


def is_diverging(world: LoggedWorld) -> bool:
    """Say whether the simulation of a world explodes."""
    return any(True for _ in _find_explosions(world))


def _fast(log: WorldLog, body: WorldBody, states: Array) -> Iterator[tuple[float, str, str, Place]]:
    for row, column in np.argwhere(~np.isfinite(states))[:1].tolist():
        value, place = str(states[row, column]), log.places[row]
        message = f"the state of {body.name} is {value} {name_place(place)}"
        yield math.inf, body.name, message, {**place, "value": value, "expected": "finite"}
        return
    linear, angular = (np.linalg.norm(states[:, part], axis=1) for part in (VELOCITY, ANGULAR))
    fastest = FASTEST_BASE + float(linear[0])  # a rocket may begin with 100
    parts = [(body.name, "m/s", fastest, linear), (body.name, "rad/s", FASTEST_JOINT, angular)]
    for joint, speeds in zip(body.joints, np.abs(states[:, JOINTS + len(body.joints) :]).T, strict=True):
        unit, limit = ("rad/s", FASTEST_JOINT) if joint.is_angle else ("m/s", FASTEST_SLIDE)
        parts.append((body.name_joint(joint), unit, limit, speeds))
    for part, unit, limit, speeds in parts if log.actions != "extreme" else ():
        row = int(np.argsort(speeds)[-min(LASTING_STEPS, len(speeds))])
        speed, place = float(speeds[row]), log.places[row]
        if speed > limit and not (unit == "rad/s" and FASTEST_MEANT < speed < NONSENSE):
            message = f"{part} moves at {speed:.4g} {unit} {name_place(place)}"
            yield speed, f"{part} {unit}", message, {**place, "value": speed, "expected": f"up to {limit:g}"}
