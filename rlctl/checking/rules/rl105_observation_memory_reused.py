"""RL105: observation memory reused."""

from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments.leaves import name_leaf

RULE = Rule(
    "RL105",
    "observation memory reused",
    Severity.INFO,
    meaning="""
        Two observations share memory, so a later step changes an observation that a buffer has stored. Or arrays in two
        infos do, such as a command that is drawn into the same array again.
    """,
    fix="Return a copy: `return self._observation.copy(), ...`, and `info['command'] = self.command.copy()`.",
)


@judges_records(RULE)
def _find_shared_memory(records: Records) -> Iterator[RuleFinding]:
    for trajectory, form in records.forms("memory")[:1]:
        name = name_leaf(records.require_built().leaves[form.leaf or 0])
        message = f"step {form.step} changed the {name} that the previous call had returned"
        yield RuleFinding(RULE, message, trajectory.at(form.step, steps=form.count))
    for trajectory, form in records.forms("info memory")[:1]:
        message = f"step {form.step} changed the array info[{form.type!r}] that the previous call had returned"
        yield RuleFinding(RULE, message, trajectory.at(form.step, steps=form.count))
