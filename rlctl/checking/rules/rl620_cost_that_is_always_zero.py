"""RL620: cost that is always zero."""

from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import ACTION_TERMS, WEIGHED_TERMS
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.records import CheckedEpisode, Records
from rlctl.checking.rewards import (
    ENOUGH_STEPS,
    RAW_TERMS,
    WITH_SEARCH,
    join_terms,
    require_terms,
    summarize,
)
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.term_names import CHANGE_WORDS, ENERGY_WORDS, is_about_actions
from rlctl.checking.zero_differences import ZeroDifferences

RULE = Rule(
    "RL620",
    "cost that is always zero",
    Severity.WARNING,
    meaning="""
        A reward term that is named after the actions, their change, or the effort of the motors, or that its
        source computes from the action without a limit, is exactly 0 at every recorded step, although the actions
        changed. It costs nothing, so nothing keeps the motions smooth or cheap. Terms whose name says
        that only a part counts, such as excess_torque, are not judged. An info in a plain environment, unless
        its source multiplies the term by a known number other than 0. So is a difference in the source between a
        value and what an attribute has kept of it, such as action - self.last_action, that is 0 in each step
        although the value changes, and that is paid.
    """,
    fix="""
        Look at what the term is computed from. An action must not be compared with itself: keep a copy of the last
        one, and replace it after the reward. PyBullet reports no torque of joints in TORQUE_CONTROL.
    """,
)


@judges_expressions(RULE, decides=False)
def _find_zero_differences(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    for one in noted.share(ZeroDifferences).find_paid():
        message = f"{one.whole.text} is 0 in all {len(noted.steps)} steps, whatever {one.new.text} is:"
        message += f" {one.key} has been replaced by it before"
        yield RuleFinding(RULE, message, {"term": one.whole.text, "value": 0.0}, where=one.whole.where)
    for same in noted.share(ZeroDifferences).find_same_sides():
        message = f"{same.text} subtracts a value from itself"
        yield RuleFinding(RULE, message, {"term": same.text, "value": 0.0}, where=same.where)


@judges_records(RULE, *WITH_SEARCH, "attributes", of_absence=True)
def _find_zero_costs(records: Records) -> Iterator[RuleFinding]:
    episodes = require_terms(records)
    if _count_changes(episodes) < ENOUGH_STEPS:
        raise NotJudged(f"the actions changed in fewer than {ENOUGH_STEPS} steps")
    raw_terms = join_terms(episodes, RAW_TERMS)
    weighed: dict[str, tuple[str, int]] = records.facts.get(WEIGHED_TERMS, {})
    of_actions: set[str] = records.facts.get(ACTION_TERMS, set())
    for name, values in join_terms(episodes).items():
        raw = raw_terms.get(name)
        is_weightless = raw is not None and raw.any()
        is_action_cost = is_about_actions(name, ENERGY_WORDS | CHANGE_WORDS) or name in of_actions
        if not values.any() and not is_weightless and is_action_cost:
            message = f"reward term {name!r} is 0 at every step of {summarize(episodes)}"
            severity = Severity.INFO
            if raw is not None:
                severity = Severity.WARNING
            elif name in weighed:
                message, severity = f"{message}, although its weight is not 0", Severity.WARNING
            evidence = {"term": name, "value": 0.0, "episodes": len(episodes)}
            yield RuleFinding(RULE, message, evidence, severity, where=weighed.get(name))


def _count_changes(episodes: Sequence[CheckedEpisode]) -> int:
    """Return at how many steps the action was another one than at the step before."""
    return sum(int((np.diff(episode.taken, axis=0) != 0).any(axis=1).sum()) for episode in episodes)
