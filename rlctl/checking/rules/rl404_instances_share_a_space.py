"""RL404: instances share a space."""

from collections.abc import Iterator
from typing import Any

import gymnasium

from rlctl.checking.experiments.instances import judges_pairs
from rlctl.checking.records import ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL404",
    "instances share a space",
    Severity.WARNING,
    meaning="""
        Two instances have one space object. If one seeds or samples it, the other draws other actions: random
        actions cannot be repeated, or are the same everywhere. A space that is a new object at each read cannot
        be seeded at all. An info for observation spaces, which nobody samples.
    """,
    fix="""
        Make the spaces in the constructor, self.action_space = spaces.Box(...), not on the class or in the
        module.
    """,
)


@judges_pairs(RULE)
def _find_shared_spaces(pair: tuple[Any, Any]) -> Iterator[ChildMessage]:
    one, other = pair
    if not isinstance(one, gymnasium.Env):
        yield Skipped(RULE.id, "it is not a gymnasium.Env (RL003)")
        return
    severities = {"action_space": Severity.WARNING, "observation_space": Severity.INFO}  # nobody samples observations
    shared = []
    for name, severity in severities.items():
        first, again, others = (getattr(env, name, None) for env in (one, one, other))
        if first is not again:
            message = f"{name} is a new object each time it is read, so that seeding it has no effect"
            yield RuleFinding(RULE, message, {"value": [name], "expected": []}, severity)
        elif first is others is not None:
            shared.append(name)
    if shared:
        message = f"two instances have one object as {' and '.join(shared)}"
        yield RuleFinding(RULE, message, {"value": shared, "expected": []}, severities[shared[0]])
