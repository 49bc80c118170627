"""Reports of `check-env` as JUnit XML, which CI services show as a list of tests: a rule is a test case."""

import re
from collections import defaultdict
from xml.etree import ElementTree

from rlctl.checking.check import CheckReport
from rlctl.checking.rules import FAMILIES, RULES, RuleFinding, Severity

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def to_junit(report: CheckReport) -> str:
    """Return a report as JUnit XML; what fails the command is a failure, other findings are output of their case."""
    verdict = report.verdict
    findings: dict[str, list[RuleFinding]] = defaultdict(list)
    for finding in verdict.findings:
        findings[finding.rule].append(finding)
    waivers = report.records.built.waivers if report.records.built else {}
    accepted = {finding.rule: "known from the baseline" for finding in verdict.known}
    accepted |= {finding.rule: f"waived: {waivers[finding.rule]}" for finding in verdict.waived}
    suite = ElementTree.Element("testsuite", name=f"rlctl check-env {report.task}", time=f"{report.seconds:.3f}")
    for rule in dict.fromkeys([*verdict.judged, *accepted, *findings]):
        case = _add_case(suite, report.task, rule)
        _add_texts(case, findings[rule], strict=report.strict)
        if rule in accepted and not findings[rule]:
            _add(case, "skipped", message=accepted[rule])
    for rule, reason in {**verdict.not_applicable, **verdict.not_judged}.items():
        if rule not in findings:
            _add(_add_case(suite, report.task, rule), "skipped", message=reason)
    for name, trace in verdict.crashed.items():
        _add(_add_case(suite, report.task, name), "error", trace, message="a bug in rlctl")
    if report.strict and (late := report.out_of_time):
        message = f"no time to judge {', '.join(late)}: --budget SECONDS"
        _add(_add_case(suite, report.task, "time ran out"), "failure", message=message, type="error")
    for kind, tag in (("tests", "testcase"), ("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
        suite.set(kind, str(len(list(suite.iter(tag)))))
    root = ElementTree.Element("testsuites")
    root.append(suite)
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, "unicode") + "\n"


def _add_case(suite: ElementTree.Element, task: str, rule: str) -> ElementTree.Element:
    name = f"{rule} {RULES[rule].name}" if rule in RULES else rule
    # CI services put the reports of a pipeline together, and keep one of two cases of the same class and name.
    classname = _clean(f"{task}.{FAMILIES.get(rule[:3], 'check-env')}")
    return ElementTree.SubElement(suite, "testcase", classname=classname, name=_clean(name))


def _add_texts(case: ElementTree.Element, findings: list[RuleFinding], *, strict: bool) -> None:
    for finding in findings:
        text = f"{finding.message}\nfix: {finding.fix}"
        if finding.severity is Severity.ERROR or (strict and finding.severity is Severity.WARNING):
            _add(case, "failure", text, message=finding.message.partition("\n")[0], type=str(finding.severity))
        else:
            _add(case, "system-out", f"{finding.severity}: {text}")


def _add(case: ElementTree.Element, tag: str, text: str = "", **attributes: str) -> None:
    element = ElementTree.SubElement(case, tag, {name: _clean(value) for name, value in attributes.items()})
    element.text = _clean(text) or None


def _clean(text: str) -> str:
    """Return a text without the characters that XML cannot have."""
    return _NOT_XML.sub("?", text)
