"""RL814: motor weaker than gravity."""

from collections.abc import Iterator

from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.world_logs import LoggedWorld

RULE = Rule(
    "RL814",
    "motor weaker than gravity",
    Severity.WARNING,
    meaning="""
        A motor with a position target cannot hold the weight of the robot at reset: its greatest force is below
        what the engine's inverse dynamics demands. The joint sags whatever the policy does.
    """,
    fix="""
        Give the motor its real strength, in N m: force= of setJointMotorControl2, forces= of
        setJointMotorControlArray, forcerange of a MuJoCo actuator.
    """,
    shows_one=True,
)


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for world in watched.worlds:
        yield from _find_weak_motors(world)


def _find_weak_motors(world: LoggedWorld) -> Iterator[RuleFinding]:
    log = world.logs[0]
    for key, needed in log.weights.items() if len(log.targets) > 1 else ():
        target = log.targets[1].get(key)
        if target is not None and 0 < target.force < needed:
            joint = next(j for body in world.world.bodies for j in body.joints if (body.id, j.index) == key)
            unit = "N m" if joint.is_angle else "N"
            holding = f"to hold the weight at reset takes {needed:.4g} {unit}"
            message = f"the motor of {joint.name} has at most {target.force:.4g} {unit}, and {holding}"
            evidence = {"element": joint.name, "value": target.force, "expected": needed}
            yield RuleFinding(RULE, message, evidence, where=target.where)
            return
