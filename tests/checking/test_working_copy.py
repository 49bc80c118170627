"""Findings in an installed copy of this folder's package, and an installation that is not what this folder has."""

import dataclasses
import json

import pytest

from rlctl.checking import tool_formats
from rlctl.checking.check import CheckReport, CheckVerdict
from rlctl.checking.formats import show_notes
from rlctl.checking.records import Built, Records
from rlctl.checking.rule import RuleFinding
from rlctl.checking.rule_index import RULES
from rlctl.checking.working_copy import find_outdated, find_working_copy, prefer_working_copy


@pytest.fixture(params=["", "src", "packages/team/src"])
def copies(request, tmp_path, monkeypatch):
    """The same package, installed and in the current folder."""
    installed, here = tmp_path / "venv/site-packages/team", tmp_path / "repository"
    for package in (installed, here / request.param / "team"):
        package.mkdir(parents=True)
        for name in ("__init__.py", "dock.py", "model.py"):
            (package / name).write_text(f"# {name}\n")
    monkeypatch.chdir(here)
    monkeypatch.delenv("GITHUB_WORKSPACE", raising=False)
    return installed / "dock.py", here / request.param / "team/dock.py"


def report_on(file):
    built = Built([], [], "", "", file=str(file), line=1)
    verdict = CheckVerdict(findings=[RuleFinding(RULES["RL705"], "a message", {})])
    return CheckReport("team:Dock-v0", verdict, Records("team:Dock-v0", built), 1.0, 20.0)


def test_findings_in_a_copy_are_shown_in_this_folder(copies, capfd):
    installed, own = copies
    report, name = report_on(installed), own.relative_to(own.cwd()).as_posix()
    assert f" file={name},line=1," in tool_formats.to_annotations(report)
    (result,) = json.loads(tool_formats.to_sarif(report))["runs"][0]["results"]
    assert result["locations"][0]["physicalLocation"]["artifactLocation"]["uri"] == name
    assert json.loads(tool_formats.to_json(report))["findings"][0]["file"] == str(own)
    show_notes(report, ["github"])
    assert capfd.readouterr().err == ""


def test_what_is_not_in_this_folder_is_named(copies, capfd):
    installed, own = copies
    own.unlink()
    show_notes(report_on(installed), ["github"])
    assert capfd.readouterr().err == f"1 finding in files outside of this folder, not shown in its code: {installed}\n"
    show_notes(report_on(installed), ["text"])
    assert capfd.readouterr().err == ""


def test_an_installation_of_other_code_is_noted(copies, capfd):
    installed, own = copies
    assert find_outdated(installed) is None
    (own.parent / "model.py").write_text("# another\n")
    show_notes(report_on(installed), [])
    root = own.parent.parent.relative_to(own.cwd())
    assert capfd.readouterr().err == (
        f"warning: this checked {installed.with_name('model.py')}, and {root / 'team/model.py'} of this folder "
        f"differs; to check this folder: PYTHONPATH={root} rlctl check-env team:Dock-v0\n"
    )
    own.write_text("# other lines\n")
    assert prefer_working_copy(installed) == installed
    by_file = dataclasses.replace(report_on(installed), task="../venv/site-packages/team/dock.py:Dock")
    assert by_file.outdated == ""


def test_a_virtual_environment_in_this_folder_is_not_its_source(copies):
    installed, own = copies
    inside = installed.parents[2].rename(".venv").resolve() / installed.relative_to(installed.parents[2])
    assert prefer_working_copy(inside) == own
    assert find_working_copy(own) is None
