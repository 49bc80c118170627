"""RL409: kept value not per world."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiments.batches import LATER, WORLDS, SeveralWorlds, are_equal, judges_batches
from rlctl.checking.records import ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names

RULE = Rule(
    "RL409",
    "kept value not per world",
    Severity.ERROR,
    meaning="""
        A BatchTask keeps a value between steps that is not in per_world. It is not cleared when a world is
        reset, and it changes for worlds that do not step; a plain number is the same for all worlds. A warning
        if it changed nothing in the steps that were played.
    """,
    fix="""
        Declare it, per_world = {"steps": (), "last_action": (12,)}: rlctl makes an array of a row per world and
        sets the row to 0 at resets. Change it with self.steps += 1, or in single rows.
    """,
    shows_one=True,
)

EARLIER = 2  # the value that an attribute has after so many steps replaces the one after `LATER`


@judges_batches(RULE)
def _find_kept_values(worlds: SeveralWorlds) -> Iterator[ChildMessage]:
    reference, again = worlds.play(), worlds.play()
    if not are_equal(reference, again):
        yield Skipped(RULE.id, "an episode already differs from its repetition (RL301 to RL303)")
        return
    if len(reference.rows) <= LATER + 1:
        yield Skipped(RULE.id, f"episodes ended within {len(reference.rows) - 1} steps")
        return
    earlier, later = reference.attributes[EARLIER], reference.attributes[LATER]
    found: dict[Severity, list[str]] = {Severity.ERROR: [], Severity.WARNING: []}
    for name in [name for name in later if name in earlier and not np.array_equal(earlier[name], later[name])]:
        replayed = worlds.play(replaced={name: earlier[name]})
        if not are_equal(reference, replayed):
            found[Severity.ERROR].append(f"self.{name}")
        elif np.shape(later[name])[:1] != (WORLDS,):  # one with a row per world is computed in each step
            found[Severity.WARNING].append(f"self.{name}")
    for severity, names in found.items():
        if names:
            effect = "changes what later steps give" if severity is Severity.ERROR else "is the same for all worlds"
            message = f"{list_names(names)} changes from step to step, {effect}, and is not in per_world"
            yield RuleFinding(RULE, message, {"element": names[0], "call": "step"}, severity)
            return
