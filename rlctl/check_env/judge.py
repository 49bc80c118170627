"""Lets every rule read the evidence, and adds what the libraries' checkers said, nothing twice."""

from __future__ import annotations

import dataclasses
import traceback
from collections.abc import Mapping, Sequence
from typing import Any

from rlctl.check_env.evidence import Complaint, Evidence
from rlctl.check_env.finding import Finding, NotApplicable, NotJudged, Rule, Severity
from rlctl.check_env.rules import RULES, libraries, observations
from rlctl.errors import UsageError, did_you_mean

LOADING = ("RL0", "RL216")
"""What is judged even where no instance could be built: loading, and windows that end it."""


@dataclasses.dataclass
class Verdict:
    """What the rules say."""

    findings: list[Finding] = dataclasses.field(default_factory=list)
    waived: list[Finding] = dataclasses.field(default_factory=list)
    """What the environment's class says is meant."""
    judged: list[str] = dataclasses.field(default_factory=list)
    not_judged: dict[str, str] = dataclasses.field(default_factory=dict)
    """Rule id, or the part of the environment that no rule could look into, and why."""
    not_applicable: dict[str, str] = dataclasses.field(default_factory=dict)
    """Rule id, and what this kind of environment does not have."""
    crashed: dict[str, str] = dataclasses.field(default_factory=dict)
    """Rule id or name of a study, and traceback."""


def judge(evidence: Evidence, rules: Sequence[Rule] = RULES) -> Verdict:
    """Apply the rules; the findings come worst first. Raises `UsageError` for a waiver that is none."""
    verdict = Verdict(crashed=dict(evidence.crashes))
    for rule in rules:
        _apply(rule, evidence, verdict)
    if evidence.built is not None:
        _add_complaints(evidence, rules, verdict)
        _waive(verdict, evidence.built.waivers)
    for unseen in observations.not_judged(evidence):
        name, _, reason = unseen.partition(": ")
        verdict.not_judged[name] = reason
    verdict.findings.sort(key=lambda each: (each.severity.rank, each.rule))
    return verdict


def _apply(rule: Rule, evidence: Evidence, verdict: Verdict) -> None:
    if evidence.built is None and not rule.id.startswith(LOADING):
        verdict.not_judged[rule.id] = "no instance could be built"
        return
    try:
        if rule.only_complaints and not any(problem is None for problem in evidence.checkers.values()):
            raise NotJudged("no library's checker came to its end")
        found = [rule.finding(seen) for seen in rule.check(evidence)]
    except NotJudged as reason:
        verdict.not_judged[rule.id] = str(reason)
    except NotApplicable as reason:
        verdict.not_applicable[rule.id] = str(reason)
    except Exception:  # a rule's bug must not hide what the other rules found, and must not look like a pass
        verdict.crashed[rule.id] = traceback.format_exc()
    else:
        verdict.judged.append(rule.id)
        verdict.findings += found


def _waive(verdict: Verdict, waivers: Mapping[str, str]) -> None:
    known = [rule.id for rule in RULES]
    for rule_id, reason in waivers.items():
        if rule_id not in known:
            raise UsageError(
                f"rlctl_ignore: no rule {rule_id!r}.{did_you_mean(rule_id, known)} "
                'Write rlctl_ignore = {"RL604": "why this is meant"}.'
            )
        if not reason.strip():
            raise UsageError(f"rlctl_ignore: {rule_id} is waived without a reason. Say why this is meant.")
    verdict.waived = [each for each in verdict.findings if each.rule in waivers]
    verdict.findings = [each for each in verdict.findings if each.rule not in waivers]


def _add_complaints(evidence: Evidence, rules: Sequence[Rule], verdict: Verdict) -> None:
    """Give each complaint to the rules that own it; one of them may have said the same already."""
    found = {finding.rule for finding in verdict.findings}
    said: dict[str, list[Complaint]] = {}
    owners: dict[str, Rule] = {}
    for complaint in evidence.complaints:
        if libraries.is_noise(complaint):
            continue
        owning = [rule for rule in RULES if rule.owns(complaint)]
        if any(rule.id in found for rule in owning):
            continue
        owner = owning[0] if owning else libraries.OF_CHECKER[complaint.checker]
        if owner in rules:
            owners[owner.id] = owner
            said.setdefault(owner.id, []).append(complaint)
    for rule_id, complaints in said.items():
        verdict.findings += _from_complaints(owners[rule_id], complaints)


def _from_complaints(rule: Rule, complaints: list[Complaint]) -> list[Finding]:
    if rule in libraries.OF_CHECKER.values():  # unrelated complaints of one checker
        return [_finding(rule, [each]) for each in complaints]
    return [_finding(rule, complaints)]


def _finding(rule: Rule, complaints: list[Complaint]) -> Finding:
    severity = rule.severity
    refused = any(each.kind == "error" for each in complaints)
    if rule in libraries.OF_CHECKER.values() and refused:
        severity = Severity.ERROR
    elif severity is Severity.ERROR and not refused:
        severity = Severity.WARNING  # the library only warns, and the rule itself saw nothing
    said_by = list(dict.fromkeys(each.checker for each in complaints))
    evidence: dict[str, Any] = {"said_by": " and ".join(said_by)}
    return Finding(rule.id, severity, rule.name, complaints[0].text, evidence, rule.fix)
