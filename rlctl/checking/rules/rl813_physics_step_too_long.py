"""RL813: physics step too long."""

from collections.abc import Iterator

from rlctl.checking.experiments.worlds import judges_logs
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.world_logs import LoggedWorld

RULE = Rule(
    "RL813",
    "physics step too long",
    Severity.WARNING,
    meaning="""
        A step of the physics is longer than 0.02 s. Bodies then move through each other, contacts and motors
        are soft or explode, and a policy does not work on the robot. A control step may be longer: it has
        several physics steps.
    """,
    fix="""
        PyBullet - leave setTimeStep at 1/240 s, and call stepSimulation several times per action. MuJoCo - set
        the option timestep to 0.002 to 0.005, and nstep of mj_step. In a task of rlctl raise `substeps`.
    """,
)

LONGEST_TIME_STEP = 0.02  # PyBullet's own is 1/240 [s]


@judges_logs(RULE)
def _find_long_step(world: LoggedWorld) -> Iterator[RuleFinding]:
    if world.time_step > LONGEST_TIME_STEP:
        evidence = {"value": world.time_step, "expected": f"up to {LONGEST_TIME_STEP:g}"}
        yield RuleFinding(RULE, f"a step of the physics takes {world.time_step:.4g} s", evidence)
