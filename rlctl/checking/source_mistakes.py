"""Mistakes that the experiment `expressions` found in lines of the source, each for a rule."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding

MISTAKES = "mistakes of the source"
"""The fact with all of them."""


@dataclasses.dataclass(frozen=True)
class SourceMistake:
    """A line of the source that is wrong."""

    rule: str  # its id
    message: str
    evidence: Mapping[str, Any]
    where: tuple[str, int]


def report_mistakes(records: Records, rule: Rule) -> Iterator[RuleFinding]:
    """Yield the first mistake of a rule."""
    found: list[SourceMistake] = records.facts.get(MISTAKES, [])
    for one in found:
        if one.rule == rule.id:
            yield RuleFinding(rule, one.message, dict(one.evidence), where=one.where)
            return
