"""RL808: physicsClientId left out."""

import sys
from collections.abc import Iterator, Sequence

from rlctl.checking.experiments.instances import judges_bullet_calls
from rlctl.checking.records import ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.environments.bullet_calls import BulletCall

RULE = Rule(
    "RL808",
    "physicsClientId left out",
    Severity.ERROR,
    meaning="""
        PyBullet is called without physicsClientId and uses client 0, whoever made it. One instance alone works;
        the second instance in a process then moves the world of the first, and closing one ends the other.
    """,
    fix="""
        Keep the id that connect returns and pass physicsClientId=self.client to every call, or make all calls
        through pybullet_utils.bullet_client.BulletClient, which adds it.
    """,
)


@judges_bullet_calls(RULE)
def _find_left_out_clients(calls: Sequence[BulletCall]) -> Iterator[ChildMessage]:
    if "pybullet" not in sys.modules:
        yield Skipped(RULE.id, "no PyBullet world", applies=False)
    if calls:
        count = f"{len(calls)} calls" if len(calls) > 1 else "a call"
        shown = list_names([f"{call.place} {call.name}" for call in calls], most=3)
        evidence = {"file": calls[0].file, "line": calls[0].line, "places": [call.place for call in calls[:20]]}
        yield RuleFinding(RULE, f"{count} of PyBullet without physicsClientId: {shown}", evidence)
