"""The gate: every step is taken, one report says what is wrong, and one exit code."""

import dataclasses
import json
from pathlib import Path
from xml.etree import ElementTree

import pytest

from rlctl.errors import ArtifactError, UsageError
from rlctl.evaluation.eval_request import NO_GATES, EvalRequest, Gates
from rlctl.evaluation.evaluate import run_evaluation
from rlctl.gating.gate import GateReport, GateRequest, GateStep, Result
from rlctl.gating.report import as_json, to_markdown
from rlctl.runs.compare.comparison import ComparisonGate
from rlctl.storage import junit
from tests.evaluation.conftest import block_run  # noqa: F401 - a fixture

PASSED = GateStep("check", Result.PASSED, "no findings")
MISSED = GateStep("eval", Result.FAILED, "success 50 %", ("success rate 0.500 is below 0.9",), exit_code=1, seconds=2.0)
DAMAGED = GateStep("compare", Result.ERROR, "used.onnx: damaged", ("used.onnx: damaged",), exit_code=5)
LEFT_OUT = GateStep("export", Result.SKIPPED, "nothing is written after a step that failed")


def make_report(*steps):
    return GateReport("reach", Path("new.safetensors"), list(steps), Gates(min_success=0.9))


@pytest.mark.parametrize(
    ("steps", "code"),
    [([PASSED], 0), ([PASSED, MISSED, LEFT_OUT], 1), ([MISSED, DAMAGED], 5), ([PASSED, LEFT_OUT], 0)],
)
def test_one_exit_code_stands_for_all_steps(steps, code):
    report = make_report(*steps)
    assert report.exit_code == code
    assert as_json(report)["exit_code"] == code
    assert as_json(report)["passed"] == (code == 0)


def test_junit_has_a_case_for_each_step():
    (suite,) = ElementTree.fromstring(junit.to_xml(make_report(PASSED, MISSED, DAMAGED, LEFT_OUT).make_suites()))
    counts = {name: suite.get(name) for name in ("tests", "failures", "errors", "skipped")}
    assert counts == {"tests": "4", "failures": "1", "errors": "1", "skipped": "1"}
    (failed,) = suite.findall("testcase/failure")
    assert failed.get("message") == "success rate 0.500 is below 0.9"
    assert [case.get("classname") for case in suite] == ["reach.gate"] * 4


def test_junit_counts_a_missed_gate_once(block_run):  # noqa: F811
    report = make_report(PASSED, MISSED, LEFT_OUT)
    evaluation = run_evaluation(EvalRequest(str(block_run.path), episodes=2))
    report = dataclasses.replace(report, evaluation=evaluation, gates=Gates(min_return=1e9))
    own, steps = ElementTree.fromstring(junit.to_xml(report.make_suites()))
    assert (own.get("failures"), steps.get("failures")) == ("1", "0")
    assert [case.get("name") for case in steps] == ["check", "export"]
    passed = dataclasses.replace(report, steps=[PASSED, dataclasses.replace(PASSED, name="eval")], gates=NO_GATES)
    own, steps = ElementTree.fromstring(junit.to_xml(passed.make_suites()))
    assert [case.get("name") for case in steps] == ["check", "eval"]


def test_markdown_has_a_row_for_each_step():
    lines = to_markdown(make_report(PASSED, MISSED)).splitlines()
    assert lines[0] == "**rlctl gate not passed: new.safetensors on reach**"
    assert lines[-2:] == ["| check | passed | no findings |", "| eval | failed | success rate 0.500 is below 0.9 |"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gates": NO_GATES}, r"^gate: say what the policy must reach, e\.g\. --min-success-lower 0\.9"),
        ({"comparison": ComparisonGate(margin=0.05)}, r"^--margin: with what is it compared\? Add --against"),
        ({"export": Path("policy.txt")}, r"^--export policy\.txt: give a name that ends in \.onnx or \.c$"),
    ],
)
def test_a_gate_that_could_not_say_no_is_refused(options, message):
    with pytest.raises(UsageError, match=message):
        GateRequest(**{"evaluation": EvalRequest("x"), "gates": Gates(min_success=0.9), **options})


def test_a_comparison_is_enough():
    GateRequest(EvalRequest("x"), NO_GATES, against=Path("used.safetensors"))


def test_options_of_the_check_need_the_check(rlctl):
    done = rlctl("gate", "x.safetensors", "--min-success", 0.5, "--no-check", "--sarif", "gate.sarif")
    assert done.returncode == UsageError.exit_code
    assert done.stderr == "error: --sarif is for the check, which --no-check leaves out\n"


def test_without_a_policy_the_files_say_so(rlctl, tmp_path):
    files = ("--json", "gate.json", "--junit", "gate.xml", "--sarif", "gate.sarif", "--markdown", "gate.md")
    done = rlctl("gate", "nothing.onnx", "--min-success", 0.5, *files)
    assert done.returncode == ArtifactError.exit_code
    assert json.loads((tmp_path / "gate.json").read_text())["exit_code"] == ArtifactError.exit_code
    (suite,) = ElementTree.fromstring((tmp_path / "gate.xml").read_text())
    assert suite.get("errors") == "1"
    assert "no such file" in (tmp_path / "gate.md").read_text()
    (run,) = json.loads((tmp_path / "gate.sarif").read_text())["runs"]
    assert run["invocations"][0]["executionSuccessful"] is False


@pytest.mark.slow
def test_all_steps_of_a_policy(rlctl, block_run, tmp_path):  # noqa: F811
    used = tmp_path / "used.safetensors"
    used.write_bytes(block_run.best_policy.read_bytes())
    files = ("--json", "gate.json", "--junit", "gate.xml", "--sarif", "gate.sarif", "--markdown", "gate.md")
    options = ("--episodes", 3, "--against", used, "--export", "policy.onnx", "--set", "randomize=false")
    done = rlctl("gate", block_run.path, "--min-success", 0.5, *options, *files)
    content = json.loads((tmp_path / "gate.json").read_text())
    results = {step["name"]: step["result"] for step in content["steps"]}
    assert (results["eval"], results["compare"]) == ("passed", "passed"), done.stdout + done.stderr
    assert done.returncode == content["exit_code"]
    # An environment whose actions do nothing is one of the mistakes that the check finds.
    assert (results["check"], results["export"], done.returncode) == ("failed", "skipped", 1)
    assert not (tmp_path / "policy.onnx").exists()
    assert json.loads((tmp_path / "gate.sarif").read_text())["runs"][0]["results"]
    assert (tmp_path / "gate.md").read_text().startswith("**rlctl gate not passed")
    *_, steps = ElementTree.fromstring((tmp_path / "gate.xml").read_text())
    assert [case.get("name") for case in steps] == ["eval", "compare", "export"]  # the rules are cases of their own
    done = rlctl("gate", block_run.path, "--no-check", *options[:4], "--set", "randomize=false", "--json", "gate.json")
    results = [step["result"] for step in json.loads((tmp_path / "gate.json").read_text())["steps"]]
    assert (results, done.returncode) == (["skipped", "passed", "passed", "skipped"], 0)
