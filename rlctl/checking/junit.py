"""Reports of `check-env` as JUnit XML: a rule is a test case."""

from collections import defaultdict

from rlctl.checking.check import CheckReport
from rlctl.checking.rule import RuleFinding, Severity
from rlctl.checking.rule_index import FAMILIES, RULES
from rlctl.storage import junit
from rlctl.storage.junit import Case, CaseEntry, Suite


def to_junit(report: CheckReport) -> str:
    """Return a report as JUnit XML; what fails the command is a failure, other findings are output of their case."""
    return junit.to_xml([make_suite(report)])


def make_suite(report: CheckReport) -> Suite:
    """Return the test cases of a report."""
    verdict = report.verdict
    findings: dict[str, list[RuleFinding]] = defaultdict(list)
    for finding in verdict.findings:
        findings[finding.rule].append(finding)
    waivers = report.records.built.waivers if report.records.built else {}
    accepted = {finding.rule: "known from the baseline" for finding in verdict.known}
    accepted |= {finding.rule: f"waived: {waivers[finding.rule]}" for finding in verdict.waived}
    skipped = {**verdict.not_applicable, **verdict.not_judged, **accepted}
    known = {*verdict.judged, *findings, *skipped}
    others = [name for name in skipped if name not in RULES]  # parts of the environment
    cases = []
    for rule in [*(rule for rule in RULES if rule in known), *others]:
        outcomes = [_describe(finding, strict=report.strict) for finding in findings.get(rule, [])]
        if rule in skipped and not outcomes:
            outcomes.append(CaseEntry("skipped", message=skipped[rule]))
        cases.append(_make_case(report.task, rule, *outcomes))
    for name, trace in verdict.crashed.items():
        cases.append(_make_case(report.task, name, CaseEntry("error", message="a bug in rlctl", text=trace)))
    if report.fails_for_time:
        message = f"no time to judge {', '.join(report.out_of_time)}: --budget {report.needed_budget}"
        cases.append(_make_case(report.task, "time ran out", CaseEntry("failure", message=message, type="error")))
    return Suite(f"rlctl check-env {report.task}", report.seconds, cases)


def _make_case(task: str, rule: str, *outcomes: CaseEntry) -> Case:
    name = f"{rule} {RULES[rule].name}" if rule in RULES else rule
    return Case(f"{task}.{FAMILIES.get(rule[:3], 'check-env')}", name, outcomes)


def _describe(finding: RuleFinding, *, strict: bool) -> CaseEntry:
    text = f"{finding.message}\nfix: {finding.fix}"
    if finding.severity is Severity.ERROR or (strict and finding.severity is Severity.WARNING):
        first_line = finding.message.partition("\n")[0]
        return CaseEntry("failure", message=first_line, text=text, type=str(finding.severity))
    return CaseEntry("system-out", text=f"{finding.severity}: {text}")
