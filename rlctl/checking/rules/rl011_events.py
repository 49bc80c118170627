"""RL011: events."""

import dataclasses
from collections.abc import Iterator

from rlctl.checking.experiments.variants import TaskVariants, describe_cause, is_repeatable, judges_variants
from rlctl.checking.instance import EnvironmentRaised
from rlctl.checking.records import ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL011",
    "events",
    Severity.ERROR,
    meaning="""
        A task's events, which `randomize: true` in a recipe switches on, do not work: one names a body that
        does not exist, raises, or does not draw from the generator it is given. If the check runs with events,
        it also tries without them.
    """,
    fix="""
        Correct the event that the message names. Use the names of bodies, links and joints in the model, ranges
        as the function expects them, and draw only from the given generator.
    """,
    needs_instance=False,
)


@judges_variants(RULE)
def _play_events(variants: TaskVariants) -> Iterator[ChildMessage]:
    context = variants.context
    if not variants.task.events:
        yield Skipped(RULE.id, "the task has no events", applies=False)
        return
    for randomize in {True, False} - {context.spec.randomize}:
        where = f"with randomize={str(randomize).lower()}"
        try:
            same = is_repeatable(context, dataclasses.replace(context.spec, randomize=randomize))
        except EnvironmentRaised as error:
            yield RuleFinding(RULE, f"{where}: {describe_cause(error)}")
            continue
        if variants.repeats and not same:
            yield RuleFinding(RULE, f"{where}: equal seeds and actions give unequal episodes")
