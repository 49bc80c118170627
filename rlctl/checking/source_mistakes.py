"""Mistakes that the experiment `expressions` found in lines of the source, each for a rule."""

import dataclasses
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding

MISTAKES = "mistakes of the source"
"""The fact with all of them."""
FRAME_RULES = {"RL123", "RL124", "RL125", "RL127", "RL128", "RL129"}
"""The rules that find vectors in wrong frames by what is observed and paid."""


@dataclasses.dataclass(frozen=True)
class SourceMistake:
    """A line of the source that is wrong."""

    rule: str  # its id
    message: str
    evidence: Mapping[str, Any]
    where: tuple[str, int]
    same: Collection[str] = ()  # the rules that find the same by what is observed and paid


def report_mistakes(records: Records, rule: Rule) -> Iterator[RuleFinding]:
    """Yield the first mistake of a rule that no experiment has found."""
    found: list[SourceMistake] = records.facts.get(MISTAKES, [])
    for one in found:
        if one.rule == rule.id and not any(finding.rule in one.same for finding in records.findings):
            yield RuleFinding(rule, one.message, dict(one.evidence), where=one.where)
            return
