"""RL838: command lasts for one physics step."""

from collections.abc import Iterator

from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.short_commands import find_short_commands

RULE = Rule(
    "RL838",
    "command lasts for one physics step",
    Severity.WARNING,
    meaning="""
        A step of the environment takes several steps of the physics, and the force, torque or command that follows from
        the action acts in one of them only. PyBullet sets applyExternalForce, applyExternalTorque and the torques of
        TORQUE_CONTROL back to 0 in each stepSimulation; in MuJoCo data.ctrl, qfrc_applied and xfrc_applied stay, and
        the source sets them to 0 after the first mj_step. The robot is as strong as the number of steps is small. What
        comes only now and then, such as a push, may be an impulse and is left out.
    """,
    fix="""
        PyBullet: call it before each stepSimulation, in the loop. MuJoCo: set it to 0 after the loop, or not at all.
    """,
)


@judges_worlds(RULE)
def _find_short_commands(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in find_short_commands(watched):
        what = f"{one.name} at {one.place.place}" if one.place is not None else one.name
        message = f"{what} follows from the action and acts in one of the {one.steps} steps of the physics of each step"
        evidence = {"element": one.name, "value": 1, "expected": one.steps}
        where = None if one.place is None else (one.place.file, one.place.line)
        yield RuleFinding(RULE, message, evidence, where=where)
        return
