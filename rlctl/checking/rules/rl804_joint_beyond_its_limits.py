"""RL804: joint beyond its limits."""

import math
from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiments.worlds import judges_logs
from rlctl.checking.records import ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.rules.rl805_simulation_explodes import is_diverging
from rlctl.checking.world_logs import LASTING_STEPS, LoggedWorld, Place, WorldLog, name_place
from rlctl.checking.worlds import JOINTS, Array, Joint
from rlctl.environments.bullet_calls import FULL_TURN

RULE = Rule(
    "RL804",
    "joint beyond its limits",
    Severity.WARNING,
    meaning="""
        A joint is far outside the limits that its model declares. The real joint cannot go there. In MuJoCo,
        whose limits are soft by design, a joint is judged that a reset puts there, or that is there most of the
        time. If limits are 57.3 times too narrow, its compiler has read radians as degrees.
    """,
    fix="""
        Clip motor targets to the joint's limits (getJointInfo; model.jnt_range), draw initial positions inside
        them, and limit the motors' force. Limits are springs, not walls, and neither resetJointState nor
        writing qpos respects them.
    """,
)

PART_OF_RANGE, LEAST_ANGLE, LEAST_LENGTH = 0.1, 0.05, 0.01
"""How far outside its limits a joint may be: part of the range, and at least so much [rad], [m]."""
MOST_ANGLE = 0.12
"""And at most so much [rad]: strong motors hold a light link of PyBullet 0.25 rad beyond its limit (joint 6 of the KUKA
iiwa, 300 N m), and a limit that is far from the other one is as hard."""
RADIANS = 'Write <compiler angle="radian"/> into the model file: angles in MJCF are degrees unless it says so.'


@judges_logs(RULE)
def _find_joints_beyond_limits(world: LoggedWorld) -> Iterator[ChildMessage]:
    if is_diverging(world):
        yield Skipped(RULE.id, "the simulation diverges (RL805)")  # which explains what else is odd
        return
    joints: list[tuple[float, str, Joint, int, Place, float]] = []
    for log in world.logs:
        for body, states in log.bodies:
            for j, joint in enumerate(body.joints):
                positions = states[:, JOINTS + j]
                outside = measure_outside(joint, positions)
                steps, row = int((outside > 0).sum()), int(outside.argmax())
                if _is_kept_there(log, outside):
                    name, place = body.name_joint(joint), log.places[row]
                    joints.append((float(outside[row]), name, joint, steps, place, float(positions[row])))
    joints.sort(key=lambda record: -record[0])
    names = list(dict.fromkeys(record[1] for record in joints))
    for widths, name, joint, steps, place, value in joints[:1]:
        unit = "rad" if joint.is_angle else "m"
        more = f"; outside of theirs are {list_names(names[1:])}" if names[1:] else ""
        limits = f"its limits are [{joint.low:.3g}, {joint.high:.3g}] {unit}"
        lasts = f"it is far outside them in {steps} steps{more}"
        message = f"{name} is at {value:.3g} {unit} {name_place(place)}; {limits}; {lasts}"
        evidence = {**place, "joint": name, "value": value, "expected": [joint.low, joint.high]}
        fix = ""
        if _is_read_as_degrees(world, joint, widths):
            low, high = np.degrees([joint.low, joint.high])
            message += f". The model file may have meant {low:.4g} to {high:.4g} in radians, and was read in degrees"
            fix = RADIANS
        yield RuleFinding(RULE, message, {**evidence, "other_joints": names[1:]}, fix=fix)


def _is_read_as_degrees(world: LoggedWorld, joint: Joint, widths: float) -> bool:
    """Say whether limits look like radians that MuJoCo's compiler took for degrees, as it does unless it is told: no
    hinge has wider ones than a full turn of such degrees, and this one is outside by more than their width."""
    limited = [j for body in world.world.bodies for j in body.joints if j.is_angle and j.has_limits]
    is_small = all(max(abs(j.low), abs(j.high)) <= math.radians(FULL_TURN) for j in limited)
    return world.world.engine == "MuJoCo" and joint in limited and is_small and widths > 1


def _is_kept_there(log: WorldLog, outside: Array) -> bool:
    """Say whether a joint is beyond its limits for more than a moment. MuJoCo's limits are soft by design: what counts
    there is where a reset puts a joint, or where it mostly is."""
    steps = int((outside > 0).sum())
    if log.world.engine == "MuJoCo":
        is_mostly = steps > max(LASTING_STEPS, len(outside) // 2)
        return bool(outside[0] > 0) or (is_mostly and log.actions != "extreme")
    return steps >= LASTING_STEPS


def measure_outside(joint: Joint, values: Array) -> Array:
    """Return how far a joint is outside its limits, in parts of their width; 0 where that is little."""
    if not joint.has_limits:
        return np.zeros(len(values))
    width = joint.high - joint.low
    allowed = max(PART_OF_RANGE * width, LEAST_LENGTH)
    if joint.is_angle:
        allowed = min(max(PART_OF_RANGE * width, LEAST_ANGLE), MOST_ANGLE)
    outside = np.maximum(joint.low - values, values - joint.high)
    return np.where(np.isfinite(outside) & (outside > allowed), outside / width, 0.0)
