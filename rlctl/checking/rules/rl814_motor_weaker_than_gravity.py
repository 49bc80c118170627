"""RL814: motor weaker than gravity."""

from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.world_logs import LoggedWorld, WorldLog
from rlctl.checking.worlds import JOINTS, Joint, WorldBody

RULE = Rule(
    "RL814",
    "motor weaker than gravity",
    Severity.WARNING,
    meaning="""
        A motor with a position target cannot hold the weight of the robot at reset: its greatest force is below
        what the engine's inverse dynamics demands. The joint sags whatever the policy does. Or a motor that is told
        speeds or forces, of a joint that falls to the same side in all episodes.
    """,
    fix="""
        Give the motor its real strength, in N m: force= of setJointMotorControl2, forces= of
        setJointMotorControlArray, max_force= of a task, forcerange of a MuJoCo actuator. See whether forces are in the
        order of the joints.
    """,
    shows_one=True,
)


LONG = 30  # looks of an episode at whose end a joint is compared
AT_STOP = 0.02  # part of the range of a joint


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for world in watched.worlds:
        yield from list(_find_weak_motors(world)) or _find_fallen_joints(world)


def _find_weak_motors(world: LoggedWorld) -> Iterator[RuleFinding]:
    log = world.logs[0]
    for key, needed in log.weights.items() if len(log.targets) > 1 else ():
        target = log.targets[1].get(key)
        if target is not None and 0 < target.force < needed:
            joint = next(j for body in world.world.bodies for j in body.joints if (body.id, j.index) == key)
            yield _describe(joint, target.force, needed, target.where)
            return


def _find_fallen_joints(world: LoggedWorld) -> Iterator[RuleFinding]:
    """Yield a motor that is told speeds or forces, and whose joint falls whatever it is told."""
    logs = [log for log in world.logs if len(log.states) > LONG]
    strengths = world.reader.read_strengths() if len({log.actions for log in logs}) > 1 else {}
    for body in world.world.bodies:
        for place, joint in enumerate(body.joints):
            key = body.id, joint.index
            strength, needed = strengths.get(key), world.logs[0].weights.get(key, 0.0)
            is_weak = strength is not None and strength.is_driven and strength.force < needed
            if is_weak and strength is not None and _falls(logs, body, place):
                yield _describe(joint, strength.force, needed, strength.where)
                return


def _falls(logs: Sequence[WorldLog], body: WorldBody, place: int) -> bool:
    """Say whether a joint ends at the same limit in all episodes, and did not begin there; a slide, which cannot swing,
    whether it goes the same way in all."""
    joint = body.joints[place]
    rows = [states[:, JOINTS + place] for log in logs for logged, states in log.bodies if logged.id == body.id]
    if not joint.is_angle:
        return len({float(np.sign(row[-1] - row[0])) for row in rows} - {0.0}) == 1
    if not joint.has_limits:
        return False
    near = AT_STOP * (joint.high - joint.low)
    for stop in (joint.low, joint.high):
        has_moved = any(abs(row[0] - stop) > near for row in rows)
        if has_moved and all(abs(row[-1] - stop) < near for row in rows):
            return True
    return False


def _describe(joint: Joint, force: float, needed: float, where: tuple[str, int] | None) -> RuleFinding:
    unit = "N m" if joint.is_angle else "N"
    holding = f"to hold the weight at reset takes {needed:.4g} {unit}"
    message = f"the motor of {joint.name} has at most {force:.4g} {unit}, and {holding}"
    return RuleFinding(RULE, message, {"element": joint.name, "value": force, "expected": needed}, where=where)
