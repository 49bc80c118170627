"""RL407: reset of other worlds."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiments.batches import WORLDS, SeveralWorlds, judges_batches
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names

RULE = Rule(
    "RL407",
    "reset of other worlds",
    Severity.ERROR,
    meaning="The reset of one world of a BatchTask changes the others, in the middle of their episodes.",
    fix="""
        Write only the rows of the worlds that are reset: self.goal[worlds] = ..., not self.goal[:] = ...; and
        self.body.set_base(positions, worlds=worlds), so for set_joints.
    """,
    shows_one=True,
)


@judges_batches(RULE)
def _find_reset_of_others(worlds: SeveralWorlds) -> Iterator[ChildMessage]:
    worlds.play()
    reset = 2
    before = worlds.read_others(reset)
    worlds.reset([reset], [FIRST_SEED + 50])
    after = worlds.read_others(reset)
    if changed := [name for name, values in before.items() if not np.array_equal(values, after[name], equal_nan=True)]:
        message = f"the reset of world {reset} of {WORLDS} changes in the others: {list_names(changed, most=4)}"
        yield RuleFinding(RULE, message, {"element": changed[0], "call": "reset"})
