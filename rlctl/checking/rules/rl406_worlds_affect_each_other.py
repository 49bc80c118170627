"""RL406: worlds affect each other."""

from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.differences import NEARLY
from rlctl.checking.experiments.batches import COMPARED, Rows, SeveralWorlds, judges_batches
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL406",
    "worlds affect each other",
    Severity.ERROR,
    meaning="""
        In a BatchTask the episode of a world changes with the seeds and actions of the other worlds, or differs
        from the episode of one world alone. What a policy learns then depends on how many worlds a worker has,
        and no episode can be reproduced. A mean, a maximum or a sort over all worlds does this, and a random
        number that all worlds share.
    """,
    fix="""
        Compute along the last axis only: np.mean(x, axis=-1), not np.mean(x). Draw random numbers in reset from
        its rng.
    """,
    shows_one=True,
)


@judges_batches(RULE)
def _find_influence(worlds: SeveralWorlds) -> Iterator[ChildMessage]:
    first, again, other = (worlds.play(others=others) for others in (0, 0, 100))
    ours, repeated, changed = ([rows[COMPARED] for rows in play.rows] for play in (first, again, other))
    if _find_difference(worlds, ours, repeated) is not None:
        yield Skipped(RULE.id, "an episode already differs from its repetition (RL301 to RL303)")
        return
    comparisons = [(changed, "other seeds and actions in the other worlds"), (list(worlds.alone), "one world alone")]
    for rows, what in comparisons:
        if (difference := _find_difference(worlds, ours, rows)) is not None:
            step, element, value, expected = difference
            at = "at reset" if step == 0 else f"at step {step}"
            is_small = abs(value - expected) <= NEARLY * max(abs(value), abs(expected), 1.0)
            shown = describe_difference(value, expected)
            message = f"the episode of a world differs with {what}: {at} {element} {shown}"
            evidence = {"element": element, "step": step, "seed": FIRST_SEED + COMPARED, "value": value}
            yield RuleFinding(RULE, message, {**evidence, "expected": expected}, Severity.WARNING if is_small else None)
            return


def _find_difference(
    worlds: SeveralWorlds, one: Sequence[Rows], two: Sequence[Rows]
) -> tuple[int, str, float, float] | None:
    """Return step, name and values of the first difference of two lists of rows, shape (size + 2,) each."""
    for step, (first, second) in enumerate(zip(one, two, strict=False)):
        if (unequal := (first != second) & ~(np.isnan(first) & np.isnan(second))).any():
            index = int(unequal.argmax())
            names = [name for name, size in worlds.names for _ in range(size)]
            return step, [*names, "reward", "terminated"][index], float(first[index]), float(second[index])
    return None


def describe_difference(value: float, expected: float) -> str:
    """Return a sentence's end for two values; where their digits are alike, it is about rounding."""
    if f"{value:.9g}" != f"{expected:.9g}":
        return f"is {value:.9g}, then {expected:.9g}"
    more = "less" if expected < value else "more"
    difference = f"{abs(value - expected):.1e} {more}"
    return f"is {value:.9g}, then {difference}: a @ b rounds as the number of rows says, a * b does not"
