"""RL807: not at rest at reset."""

from collections.abc import Iterator

from rlctl.checking.experiments.worlds import judges_logs
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import Jump

RULE = Rule(
    "RL807",
    "not at rest at reset",
    Severity.WARNING,
    meaning="""
        Right after a reset, without any action, a free body moves faster than it could fall. Episodes then
        begin with an accident.
    """,
    fix="""
        Place bodies without overlap and just above the ground; reset velocities and motor targets too, which
        resetJointState and restoreState leave unchanged.
    """,
)

FASTEST_JUMP = 1.0  # above falling, 0.1 s after a reset: ten times gravity [m/s]


@judges_logs(RULE)
def _find_unrest(world: LoggedWorld) -> Iterator[RuleFinding]:
    for jump in find_thrown(world).values():
        moves = f"{jump.body} moves at {jump.speed:.2f} m/s {jump.after_s:.2g} s after reset, without any action"
        message = f"{moves}; falling explains {jump.explained:.2f} m/s"
        evidence = {"seed": jump.seed, "body": jump.body, "value": jump.speed, "expected": jump.explained}
        yield RuleFinding(RULE, message, evidence)


def find_thrown(world: LoggedWorld) -> dict[str, Jump]:
    """Return how bodies that are not at rest after a reset move, by the name of the body."""
    return {jump.body: jump for jump in reversed(world.jumps) if jump.speed > jump.explained + FASTEST_JUMP}
