"""JUnit XML, which CI services show as a list of tests: a rule, a gate or a step is a test case."""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from rlctl.storage import files

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclasses.dataclass(frozen=True)
class CaseEntry:
    """What a test case says besides that it exists: `failure`, `error`, `skipped` or `system-out`."""

    tag: str
    message: str = ""
    text: str = ""
    type: str = ""


@dataclasses.dataclass(frozen=True)
class Case:
    """A test case; without outcomes it has passed."""

    classname: str
    name: str
    outcomes: Sequence[CaseEntry] = ()
    seconds: float | None = None  # [s]


@dataclasses.dataclass(frozen=True)
class Suite:
    """The test cases of one report."""

    name: str
    seconds: float  # [s]
    cases: Sequence[Case]


def make_gate_case(classname: str, name: str, missed: Sequence[str], text: str = "") -> Case:
    """Return the case of a gate: a failure for what was missed; `text` is what was measured."""
    outcomes = [CaseEntry("failure", message=problem, text=text, type="gate missed") for problem in missed]
    if text and not missed:
        outcomes = [CaseEntry("system-out", text=text)]
    return Case(classname, name, outcomes)


def write(path: Path, suites: Sequence[Suite]) -> None:
    """Write suites to a file; raises `ArtifactError` if it cannot be written."""
    files.write_result(path, to_xml(suites).encode())


def to_xml(suites: Sequence[Suite]) -> str:
    """Return suites as JUnit XML."""
    root = ElementTree.Element("testsuites")
    for suite in suites:
        root.append(_make_suite(suite))
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, "unicode") + "\n"


def _make_suite(suite: Suite) -> ElementTree.Element:
    element = ElementTree.Element("testsuite", name=_clean(suite.name), time=f"{suite.seconds:.3f}")
    for case in suite.cases:
        # CI services put the reports of a pipeline together, and keep one of two cases of the same class and name.
        attributes = {"classname": _clean(case.classname), "name": _clean(case.name)}
        if case.seconds is not None:
            attributes["time"] = f"{case.seconds:.3f}"
        test = ElementTree.SubElement(element, "testcase", attributes)
        for outcome in case.outcomes:
            _add_outcome(test, outcome)
    for kind, tag in (("tests", "testcase"), ("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
        element.set(kind, str(len(list(element.iter(tag)))))
    return element


def _add_outcome(test: ElementTree.Element, outcome: CaseEntry) -> None:
    attributes = {"message": outcome.message, "type": outcome.type}
    given = {name: _clean(value) for name, value in attributes.items() if value}
    ElementTree.SubElement(test, outcome.tag, given).text = _clean(outcome.text) or None


def _clean(text: str) -> str:
    """Return a text without the characters that XML cannot have."""
    return _NOT_XML.sub("?", text)
