"""What the libraries' own checkers said becomes findings of the rules that own it, and nothing is said twice."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence

from rlctl.check_env.finding import RULES, Finding, NotJudged, Severity
from rlctl.check_env.messages import GYMNASIUM, SB3, Complaint
from rlctl.check_env.records import Records

NOISE = tuple(
    re.compile(pattern)
    for pattern in (
        # Positions and velocities have no natural bound; every bundled task would have this finding.
        r"Box observation space (minimum|maximum) value is -?infinity",
        # Wrappers are what the user trains on, so they are checked as they are.
        r"is different from the unwrapped version",
        r"Not able to test alternative render modes",
        # RL108 judges this; measurements in rows and columns are no mistake.
        r"unconventional shape",
        # RL614 judges this with a tolerance: float rounding, which SB3's checker does not forgive, harms nobody.
        r"The reward was not computed with `compute_reward",
        r"computation of reward differs",
        r"reward == env\.compute_reward",
    )
)
"""Complaints that say nothing about an environment's quality."""

EXPLAINED = (
    (re.compile(r"support for the `seed` function is dropped"), {"RL202", "RL210", "RL301", "RL302", "RL308"}),
    (re.compile(r"precision lowered by casting"), {"RL102", "RL103", "RL106"}),
)
"""Complaints that no rule owns, and rules that name the cause of one where they have found something."""

UNOWNED = {GYMNASIUM: "RL290", SB3: "RL291"}
"""The rule that owns what no other rule does, per checker."""


def require_checker(records: Records, rule: str) -> None:
    """Raise `NotJudged` if no checker that could break a rule came to its end."""
    checkers = [name for name, owner in UNOWNED.items() if rule not in UNOWNED.values() or rule == owner]
    if any(records.checkers.get(name, "") is None for name in checkers):
        return
    for name in checkers:
        if records.checkers.get(name):
            raise NotJudged(f"{name}'s checker could not run: {records.checkers[name]}")
    raise NotJudged(f"{' or '.join(f'{name}' for name in checkers)}'s checker did not come to its end")


def judge_complaints(records: Records, rules: Collection[str], found: Collection[str]) -> Iterator[Finding]:
    """Yield a finding per rule that owns complaints, of some `rules`; none where an owner has `found` it already."""
    owned: dict[str, list[Complaint]] = {}
    for complaint in records.complaints:
        if any(pattern.search(complaint.text) for pattern in NOISE):
            continue
        if any(pattern.search(complaint.text) and not causes.isdisjoint(found) for pattern, causes in EXPLAINED):
            continue
        owners = [rule.id for rule in RULES.values() if rule.owns(complaint.text)]
        if any(owner in found for owner in owners):
            continue
        owner = owners[0] if owners else UNOWNED[complaint.checker]
        if owner in rules:
            owned.setdefault(owner, []).append(complaint)
    for rule, complaints in owned.items():
        if rule in UNOWNED.values():  # unrelated complaints of one checker
            yield from (_finding(rule, [each]) for each in complaints)
        else:
            yield _finding(rule, complaints)


def _finding(rule: str, complaints: Sequence[Complaint]) -> Finding:
    severity = RULES[rule].severity
    refused = any(each.kind == "error" for each in complaints)
    if rule in UNOWNED.values() and refused:
        severity = Severity.ERROR
    elif severity is Severity.ERROR and not refused:
        severity = Severity.WARNING  # the library only warns, and the rule itself has found nothing
    said_by = " and ".join(dict.fromkeys(each.checker for each in complaints))
    return Finding(rule, complaints[0].text, {"said_by": said_by}, severity)
