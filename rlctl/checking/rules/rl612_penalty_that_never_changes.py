"""RL612: penalty that never changes."""

import re
from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rewards import WITH_SEARCH, find_constant_terms, require_enough, require_terms, summarize
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL612",
    "penalty that never changes",
    Severity.WARNING,
    meaning="""
        A penalty in info["reward_terms"] has the same value at every recorded step, so it penalises nothing.
        Penalties named after time or being alive are not judged.
    """,
    fix="""
        Look at what the penalty is computed from: a wrong slice or index of the state, a value before it is
        updated, or a clip that always applies.
    """,
)

MEANT_CONSTANT = re.compile(r"(?i)(^|_)(alive(ness)?|surviv\w*|time|steps?|living|life|exist\w*|constant|bias)(_|$)")


@judges_records(RULE, *WITH_SEARCH, of_absence=True)
def _find_constant_penalty(records: Records) -> Iterator[RuleFinding]:
    episodes = require_enough(require_terms(records))
    for name, value in find_constant_terms(episodes).items():
        if value < 0 and not MEANT_CONSTANT.search(name):
            message = f"reward term {name!r} is {value:.6g} at every step of {summarize(episodes)}"
            yield RuleFinding(RULE, message, {"term": name, "value": value, "episodes": len(episodes)})
