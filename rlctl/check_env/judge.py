"""From records to a verdict: what the experiments have found, and what the checks find in the records."""

from __future__ import annotations

import dataclasses
import traceback
from collections.abc import Collection, Mapping

from rlctl.check_env import families
from rlctl.check_env.experiment import Experiment
from rlctl.check_env.finding import RULES, Finding, NotApplicable, NotJudged
from rlctl.check_env.leaves import name_leaf
from rlctl.check_env.records import Records
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
    """Rule id or name of an experiment, and traceback."""


def judge(records: Records, rules: Collection[str] = tuple(RULES)) -> Verdict:
    """Apply the rules; the findings come worst first. Raises `UsageError` for a waiver that cannot be used."""
    verdict = Verdict(crashed=dict(records.crashes))
    for rule in rules:
        _apply(rule, records, verdict)
    if records.built is not None:
        _waive(verdict, records.built.waivers)
        for leaf in records.built.leaves:
            if not leaf.supported:
                verdict.not_judged[name_leaf(leaf)] = f"no rule can look into a {leaf.kind} space"
    verdict.findings.sort(key=lambda each: (each.severity.rank, each.rule))
    return verdict


def _apply(rule: str, records: Records, verdict: Verdict) -> None:
    try:
        found = _findings(rule, records)
    except NotJudged as reason:
        verdict.not_judged[rule] = str(reason)
    except NotApplicable as reason:
        verdict.not_applicable[rule] = str(reason)
    except UsageError:  # the recipe that comes with the task
        raise
    except Exception:  # a rule's bug must not hide what the other rules found, and must not look like a pass
        verdict.crashed[rule] = traceback.format_exc()
    else:
        verdict.judged.append(rule)
        verdict.findings += found


def _findings(rule: str, records: Records) -> list[Finding]:
    """Return what the experiment that decides a rule and the rule's check have found."""
    check, experiment = families.CHECKS.get(rule), families.DECIDED_BY.get(rule)
    found = [each for each in records.findings if each.rule == rule]
    if found and records.built is None:
        return found
    if records.built is None and not rule.startswith(LOADING):
        raise NotJudged("no instance could be built")
    if check is not None and not found:
        found += check.run(records)
    if experiment is not None and not found:
        _require_complete(records, experiment, rule)
    return found


def _require_complete(records: Records, experiment: Experiment, rule: str) -> None:
    if rule in records.skipped:
        raise NotJudged(records.skipped[rule])
    if rule in records.not_applicable:
        raise NotApplicable(records.not_applicable[rule])
    if experiment.name not in records.complete and not (records.built is None and experiment.name == "build"):
        raise NotJudged(records.why_missing(experiment.name))


def _waive(verdict: Verdict, waivers: Mapping[str, str]) -> None:
    for rule, reason in waivers.items():
        if rule not in RULES:
            raise UsageError(
                f"rlctl_ignore: no rule {rule!r}.{did_you_mean(rule, RULES)} "
                'Write rlctl_ignore = {"RL604": "why this is meant"}.'
            )
        if not reason.strip():
            raise UsageError(f"rlctl_ignore: {rule} is waived without a reason. Say why this is meant.")
    verdict.waived = [each for each in verdict.findings if each.rule in waivers]
    verdict.findings = [each for each in verdict.findings if each.rule not in waivers]
