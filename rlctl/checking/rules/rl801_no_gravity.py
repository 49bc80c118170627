"""RL801: no gravity."""

from collections.abc import Iterator

from rlctl.checking.experiments.worlds import judges_logs
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.world_logs import LoggedWorld

RULE = Rule(
    "RL801",
    "no gravity",
    Severity.WARNING,
    meaning="""
        Gravity is zero although bodies have mass: that is PyBullet's default, also after resetSimulation. The
        policy trains in a world that does not exist. Judged only in PyBullet, and if gravity would change
        something: an arm that turns about upright axes does not need it. If weightlessness is intended, waive
        this rule.
    """,
    fix="Call setGravity(0, 0, -9.81, physicsClientId=self.client) after resetSimulation.",
)


@judges_logs(RULE)
def _find_no_gravity(world: LoggedWorld) -> Iterator[RuleFinding]:
    heavy = [body.name for body in world.world.bodies if body.is_free or body.has_heavy_links]
    if heavy and not any(world.gravity) and world.weight_matters is not False:
        evidence = {"value": world.gravity, "expected": [0.0, 0.0, -9.81], "bodies": heavy}
        yield RuleFinding(RULE, f"gravity is (0, 0, 0), and {list_names(heavy)} can move", evidence)
