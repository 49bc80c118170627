"""What comes out: text, JSON, SARIF and annotations, and what can be chosen: rules, waivers, strictness."""

import copy
import dataclasses
import io
import json
import os
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import jsonschema
import pydantic
import pytest
import typer
from gymnasium import spaces
from rich.console import Console

from rlctl import cli
from rlctl.checking import tool_formats
from rlctl.checking.check import CheckReport, CheckVerdict, judge
from rlctl.checking.formats import FORMATS, pair_targets, print_report, show_notes, to_text
from rlctl.checking.records import Built, Finished, Records
from rlctl.checking.rule import RuleFinding, Severity
from rlctl.checking.rule_index import FAMILIES, PROCESSES, RULES, choose_rules, find_needs, find_rule
from rlctl.environments.leaves import find_leaves
from rlctl.errors import UsageError
from tests import fork_server
from tests.checking.judging import records_of

ROOT = Path(__file__).parent.parent.parent
HERE = "tests/checking"


PROBE = PROCESSES["probe"]


def report_of(task, rules=tuple(RULES), experiments=None):
    records = records_of(task, *(experiments or {"build", *find_needs(rules)}))
    return CheckReport(task, judge(records, rules), records, 1.0, 20.0)


def test_arrays_without_elements_have_no_row():
    leaves = find_leaves(spaces.Dict(nothing=spaces.Box(-1, 1, (0,)), some=spaces.Box(-1, 1, (2,))))
    records = Records("any", Built(leaves, leaves, "", ""))
    assert [row.name for row in tool_formats.observation_rows(records)] == ["observation['some']"]
    assert [row.name for row in tool_formats.action_rows(records)] == ["action['some']"]


def rlctl(*arguments, folder=ROOT, **environment):
    command = [sys.executable, "-m", "rlctl", "check-env", *arguments]
    variables = {**os.environ, **environment}
    return fork_server.for_commands().run(command, cwd=folder, timeout=250, env=variables)


@pytest.fixture(scope="module")
def broken():
    return report_of("broken_envs.py:RL601NanReward", experiments=PROBE)


@pytest.fixture(scope="module")
def unbuilt():
    return report_of("broken_loading.py:RL007NoFile", experiments=["build"])


@pytest.fixture(scope="module")
def waiving():
    return report_of("broken_waivers.py:Wide", ["RL106"])


@pytest.fixture(scope="module")
def crashed():
    return CheckReport("any", CheckVerdict(crashed={"RL999": "Traceback ..."}), Records("any"), 1.0, 20.0)


@pytest.fixture(params=["broken", "unbuilt", "waiving", "crashed"])
def report(request):
    return request.getfixturevalue(request.param)


def test_every_report_fits_the_schema(report):
    schema = json.loads(tool_formats.SCHEMA.read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(json.loads(tool_formats.to_json(report)), schema)


def test_the_schema_refuses_what_is_no_report(broken):
    schema = json.loads(tool_formats.SCHEMA.read_text())
    for change in ({"exit_code": 2}, {"extra": 1}, {"findings": [{"rule": "RL1"}]}, {"speed": {}}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**tool_formats.describe(broken), **change}, schema)


NOT_IN_THE_VALIDATOR = {"exitCode", "suppressions", "toolExecutionNotifications"}
"""Keys of SARIF 2.1.0 (its sections 3.20.7, 3.27.23 and 3.20.21) that the validator's models lack."""


def extras(model):
    """Every key that SARIF does not have, which the validator lets pass."""
    if isinstance(model, pydantic.BaseModel):
        found = set(model.model_extra or {})
        return found.union(*(extras(value) for _, value in model))
    if isinstance(model, (list, dict)):
        return set().union(*(extras(each) for each in (model.values() if isinstance(model, dict) else model)))
    return set()


def test_every_report_is_valid_sarif(report):
    import sarif_pydantic  # takes half a second

    log = sarif_pydantic.Sarif.model_validate_json(tool_formats.to_sarif(report))
    assert extras(log) <= NOT_IN_THE_VALIDATOR
    assert log.version == "2.1.0"
    assert json.loads(tool_formats.to_sarif(report))["runs"][0]["automationDetails"] == {"id": f"rlctl/{report.task}/"}
    (run,) = log.runs
    assert [result.rule_id for result in run.results or []] == [
        each.rule for each in (*report.verdict.findings, *report.verdict.waived)
    ]
    for result in run.results or []:
        assert run.tool.driver.rules[result.rule_index].id == result.rule_id
    assert run.invocations[0].execution_successful is (not report.verdict.crashed)


def test_sarif_places_a_finding_at_the_method(broken):
    result = json.loads(tool_formats.to_sarif(broken))["runs"][0]["results"][0]
    place = result["locations"][0]["physicalLocation"]
    file = ROOT / HERE / "broken_envs.py"
    assert file.as_uri().endswith(place["artifactLocation"]["uri"])
    assert file.read_text().splitlines()[place["region"]["startLine"] - 1] == "    def step(self, action):"
    assert result["level"] == "error"


@pytest.mark.slow_except(
    "broken_waivers.py:Wide-RL106-self.action_space = spaces.Box",
    'broken_loading.py:RL002Raising-RL002-raise RuntimeError("no licence")',
    "broken_import.py:RL001Anything-RL001-raise ZeroDivisionError",
    "broken_repeats.py:RL301RL309GlobalRandom-RL301-def reset(self",
)
@pytest.mark.parametrize(
    ("task", "rule", "line"),
    [
        ("broken_waivers.py:Wide", "RL106", "self.action_space = spaces.Box"),
        ("broken_loading.py:RL002Raising", "RL002", 'raise RuntimeError("no licence")'),
        ("broken_import.py:RL001Anything", "RL001", "raise ZeroDivisionError"),
        ("broken_repeats.py:RL301RL309GlobalRandom", "RL301", "def reset(self"),
        ("broken_interface.py:CountsAsFlag", "RL204", "def step(self, action)"),
    ],
)
def test_a_place_is_the_line_that_declares_or_raises(task, rule, line):
    report = report_of(task, [rule])
    (finding,) = [*report.verdict.findings, *report.verdict.waived]
    file, number = report.locate(finding)
    assert file.name == (task.partition(":")[0] if rule != "RL301" else "broken_envs.py")  # reset is inherited
    assert file.read_text().splitlines()[number - 1].strip().startswith(line)


def test_sarif_tells_what_is_waived_and_why(waiving):
    (result,) = json.loads(tool_formats.to_sarif(waiving))["runs"][0]["results"]
    assert result["suppressions"] == [
        {"kind": "inSource", "justification": "the actions are Newtons, as the real motor has them"}
    ]


def test_annotations_point_at_the_class(broken, monkeypatch):
    monkeypatch.setenv("GITHUB_WORKSPACE", str(ROOT))
    line, last = tool_formats.to_annotations(broken).splitlines()
    assert re.match(
        r"::error file=tests/checking/broken_envs.py,line=\d+,title=RL601 reward not finite::"
        r"the reward is nan at step 13%0Afix: ",
        line,
    )
    assert last.startswith("broken_envs.py:RL601NanReward: 1 error; ") or "RL601NanReward: 1 error" in last


def test_annotations_escape_what_would_end_them(broken):
    assert tool_formats._escape_property("50 %: a, b\n") == "50 %25%3A a%2C b%0A"
    assert tool_formats._escape_data("50 %: a, b\n") == "50 %25: a, b%0A"


def test_outside_the_repository_there_is_no_place_to_annotate(broken, monkeypatch, tmp_path):
    monkeypatch.setenv("GITHUB_WORKSPACE", str(tmp_path))
    assert tool_formats.to_annotations(broken).startswith("::error title=RL601")


def test_text_has_the_finding_its_numbers_and_its_fix(broken):
    text = to_text(broken)
    assert text.startswith("error RL601  reward not finite\n  the reward is nan at step 13\n  seed 1000, episode 0, ")
    assert "\n  fix: Find the division, logarithm or diverging simulation that causes it.\n" in text
    assert "\x1b" not in text


def test_a_narrow_terminal_cuts_no_finding_off(broken):
    stream = io.StringIO()
    print_report(Console(file=stream, width=40, force_terminal=True, color_system=None, soft_wrap=True), broken)
    words = stream.getvalue().split()
    for finding in broken.verdict.findings:
        fix = f"fix: {finding.fix}".split()
        assert fix in [words[place : place + len(fix)] for place, word in enumerate(words) if word == "fix:"]


def test_waived_findings_are_listed_with_the_reason_and_do_not_count(waiving):
    assert waiving.verdict.findings == []
    assert [finding.rule for finding in waiving.verdict.waived] == ["RL106"]
    assert (
        "waived RL106 (2 of 2 actions are not in [-1, 1]: action[0] is in [-2, 2]): the actions are Newtons"
        in to_text(waiving)
    )
    assert ", 1 waived; " in waiving.summarize()


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("NoReason", "RL106 is waived without a reason"),
        ("NoSuchRule", r"no rule 'RL1006'. Did you mean 'RL106'\?"),
        ("NoDictionary", r"no rule \"\('RL106',\)\""),
    ],
)
def test_a_waiver_that_is_none_is_refused(task, message):
    with pytest.raises(UsageError, match=message):
        report_of(f"broken_waivers.py:{task}", ["RL106"])


def test_strict_counts_warnings():
    report = report_of("broken_repeats.py:RL308UnseededLater", ["RL308"])
    assert report.exit_code == 0
    assert dataclasses.replace(report, strict=True).exit_code == 1


def test_a_crash_wins(crashed):
    assert crashed.exit_code == 70


def test_rules_are_chosen_by_family_and_id():
    assert {rule[:3] for rule in choose_rules(["RL3"])} == {"RL3"}
    assert choose_rules(["rl301,RL501"]) == ["RL301", "RL501"]
    assert "RL106" not in choose_rules([], ["RL106"])
    assert choose_rules() == list(RULES)
    with pytest.raises(UsageError, match=r"--select RL35: no such rule. Did you mean 'RL"):
        choose_rules(["RL35"])
    with pytest.raises(UsageError, match="leave no rule"):
        choose_rules(["RL301"], ["RL3"])


def test_unchosen_rules_cost_nothing_and_say_nothing(broken):
    verdict = judge(broken.records, choose_rules(["RL3"]))
    assert verdict.findings == []
    assert {*verdict.judged, *verdict.not_judged} >= set(choose_rules(["RL3"]))
    assert not any(rule.startswith("RL6") for rule in verdict.judged)


def test_rules_are_found_by_id_in_any_case():
    assert find_rule("rl304").id == "RL304"
    with pytest.raises(UsageError, match=r"no rule 'RL3'. The family has: RL301, "):
        find_rule("RL3")


def test_command_lists_rules_without_a_task():
    run = rlctl("--list")
    assert run.returncode == 0
    for rule in RULES.values():
        assert f"{rule.id}  {rule.severity}" in run.stdout
    for title in FAMILIES.values():
        assert title in run.stdout


def test_command_explains_a_rule_without_a_task():
    run = rlctl("--explain", "RL304")
    assert run.returncode == 0
    assert run.stdout.startswith("RL304  a new instance differs\nerror, determinism\n")
    assert "fix: " in run.stdout
    assert rlctl("--explain", "RL9999").returncode == 2
    assert "Did you mean 'RL301'?" in rlctl("--explain", "RL3O1").stderr
    assert rlctl().returncode == 2


@pytest.mark.slow
def test_command_writes_a_file_whole_and_says_so(tmp_path):
    file = tmp_path / "report.sarif"
    run = rlctl(f"{HERE}/broken_envs.py:RL601NanReward", "--select", "RL601", "--format", "sarif", "-o", str(file))
    assert (run.returncode, run.stdout) == (1, "")
    assert run.stderr.rstrip().endswith(f"written to {file}")
    assert json.loads(file.read_text())["runs"][0]["results"][0]["ruleId"] == "RL601"


def test_junit_counts_what_it_lists(report):
    (suite,) = ElementTree.fromstring(FORMATS["junit"](report))
    cases = suite.findall("testcase")
    assert int(suite.get("tests")) == len(cases) > 0
    failed = [case for case in cases if case.find("failure") is not None]
    assert int(suite.get("failures")) == len(failed)
    errors = {finding.rule for finding in report.verdict.findings if finding.severity == "error"}
    assert {case.get("name")[:5] for case in failed} == errors
    assert int(suite.get("errors")) == len(report.verdict.crashed)
    unjudged = {**report.verdict.not_applicable, **report.verdict.not_judged}
    assert int(suite.get("skipped")) <= len({*unjudged, *(finding.rule for finding in report.verdict.waived)})
    skipped = [case.find("skipped").get("message") for case in cases if case.find("skipped") is not None]
    reasons = report.records.built.waivers if report.records.built else {}
    assert {f"waived: {reasons[finding.rule]}" for finding in report.verdict.waived} <= set(skipped)


def test_a_strict_check_fails_for_rules_without_time_to_judge_them(report):
    cut = dataclasses.replace(report.records, finished={**report.records.finished})
    assert report.out_of_time == [] or any(end.is_cut for end in report.records.finished.values())
    cut.finished["episodes"] = Finished("episodes", 1.0, is_complete=True, is_cut=True)
    others = ["RL101", "RL102", "RL103", "RL104"]
    verdict = CheckVerdict(judged=others, not_judged={"RL501": "time ran out", "RL301": "reset takes no seed"})
    late = dataclasses.replace(report, records=cut, verdict=verdict)
    assert late.out_of_time == ["RL501"]
    assert (late.exit_code, dataclasses.replace(late, strict=True).exit_code) == (
        (3, 3) if cut.built is None else (0, 1)
    )
    assert re.search(r": not finished: 1 of 5 rules not judged for lack of time .*; no findings", late.summarize())
    assert "(needs --budget 40)" in late.summarize()
    assert "::warning title=1 rules not judged::time ran out for RL501" in FORMATS["github"](late)
    assert "time ran out" not in [case.get("name") for case in junit_cases(late)]
    (case,) = [
        each for each in junit_cases(dataclasses.replace(late, strict=True)) if each.get("name") == "time ran out"
    ]
    assert case.find("failure").get("message") == "no time to judge RL501: --budget 40"


@pytest.mark.parametrize(("name", "is_shown"), [("desired_goal", True), ("Distance", True), ("joints", False)])
def test_an_environment_with_a_goal_is_told_why_the_rules_about_goals_do_not_apply(name, is_shown):
    leaves = find_leaves(spaces.Dict({name: spaces.Box(-1, 1, (2,))}))
    records = Records("any", Built(leaves, leaves, "", ""))
    reason = "the observation follows no attribute that reset draws"
    others = {"RL622": reason, "RL623": reason, "RL808": "no PyBullet world"}
    lines = to_text(CheckReport("any", CheckVerdict(not_applicable=others), records, 1.0, 20.0)).splitlines()
    assert (f"does not apply: RL622, RL623: {reason}" in lines) is is_shown
    assert "does not apply: RL622, RL623, RL808 (reasons: --json FILE)" in lines


def test_a_check_without_a_quarter_of_the_rules_is_no_pass(broken):
    finished = {**broken.records.finished, "episodes": Finished("episodes", 1.0, is_complete=True, is_cut=True)}
    verdict = CheckVerdict(judged=["RL101", "RL102", "RL103"], not_judged={"RL501": "time ran out"})
    late = dataclasses.replace(broken, records=dataclasses.replace(broken.records, finished=finished), verdict=verdict)
    assert late.exit_code == 1
    assert to_text(late).splitlines()[-1] == (
        "not passed: 1 rule not judged for lack of time: --budget 40 should judge them; --select RULES judges fewer"
    )
    content = json.loads(tool_formats.to_json(late))
    assert (content["exit_code"], content["is_incomplete"], content["needed_budget_seconds"]) == (1, True, 40)
    assert "::error title=1 rules not judged::time ran out for RL501: --budget 40" in FORMATS["github"](late)
    assert [case.find("failure") is not None for case in junit_cases(late)][-1]
    (run,) = json.loads(FORMATS["sarif"](late))["runs"]
    notification = run["invocations"][0]["toolExecutionNotifications"][0]
    assert (notification["level"], notification["message"]["text"][:10]) == ("error", "not passed")


def test_the_cases_of_junit_are_in_the_order_of_the_rules(report):
    rules = [case.get("name")[:5] for case in junit_cases(report) if case.get("name")[:5] in RULES]
    assert rules == sorted(rules)


@pytest.mark.parametrize(
    ("arguments", "pairs"),
    [
        ("", [("text", None)]),
        ("-o a", [("text", "a")]),
        ("--format sarif -o a --format junit --output=b", [("sarif", "a"), ("junit", "b")]),
        ("--format junit -o a --format text", [("junit", "a"), ("text", None)]),
        ("--format github --format junit -o a", [("github", "-"), ("junit", "a")]),
        ("--format=sarif -oa --format github --format junit -o b", [("sarif", "a"), ("github", "-"), ("junit", "b")]),
        ("-o a --format sarif", [("sarif", "a")]),
        ("--format github --format sarif", None),
        ("--format github -o a -o b", None),
    ],
)
def test_a_file_belongs_to_the_format_before_it(arguments, pairs):
    app = typer.main.get_command(cli.build_app(["check-env", "tasks"]))
    command = app.commands["check-env"]
    options = command.make_context("check-env", arguments.split()).params
    if pairs is not None:
        assert pair_targets(options["form"], options["output"]) == pairs
        return
    with pytest.raises(UsageError, match="give each --format its -o FILE after it"):
        pair_targets(options["form"], options["output"])


@pytest.mark.parametrize(("rule", "is_example"), [("RL816", True), ("RL301", True), ("RL115", False), ("RL818", False)])
def test_a_baseline_knows_a_finding_whichever_element_it_shows(broken, rule, is_example):
    one, other = (broken.fingerprint(RuleFinding(RULES[rule], "", {"element": f"action[{i}]"})) for i in range(2))
    assert (one == other) is is_example


def test_what_of_a_baseline_is_not_found_is_named_if_it_was_judged(waiving, capfd):
    report = dataclasses.replace(waiving, verdict=dataclasses.replace(waiving.verdict))
    report.verdict.judged = ["RL106", "RL115"]
    report.subtract(
        {*map(report.fingerprint, report.verdict.waived), *(f"{report.task} {x}" for x in ("RL115 a", "RL9"))}
    )
    show_notes(report, [])
    assert capfd.readouterr().err == "1 finding of the baseline no longer found: RL115 a; write it again\n"


def test_a_baseline_of_another_task_is_refused(report):
    with pytest.raises(UsageError, match=r"--baseline: its findings are of other:Env, not of "):
        report.subtract({"other:Env RL501"})


def junit_cases(report):
    return ElementTree.fromstring(FORMATS["junit"](report))[0].findall("testcase")


def test_junit_names_the_task_and_what_the_baseline_knows(broken):
    known = CheckVerdict(known=broken.verdict.findings, judged=["RL601", "RL602"])
    cases = {case.get("name")[:5]: case for case in junit_cases(dataclasses.replace(broken, verdict=known))}
    assert cases["RL601"].get("classname") == f"{broken.task}.reward"
    assert cases["RL601"].find("skipped").get("message") == "known from the baseline"
    assert list(cases["RL602"]) == []


def test_in_junit_warnings_fail_with_strict_only(broken):
    warning = copy.copy(broken.verdict.findings[0])
    warning.severity = Severity.WARNING
    for strict, failures in ((False, "0"), (True, "1")):
        verdict = CheckVerdict(findings=[warning], judged=[warning.rule])
        text = FORMATS["junit"](dataclasses.replace(broken, verdict=verdict, strict=strict))
        assert ElementTree.fromstring(text)[0].get("failures") == failures
    assert "warning: " in FORMATS["junit"](dataclasses.replace(broken, verdict=verdict, strict=False))


@pytest.mark.parametrize("form", sorted(FORMATS))
def test_every_format_says_why_nothing_could_be_built(form, unbuilt):
    assert unbuilt.exit_code == 3
    assert "RL007" in FORMATS[form](unbuilt)
    assert "gains.yaml" in FORMATS[form](unbuilt)


def test_command_says_why_nothing_could_be_built():
    run = rlctl(f"{HERE}/broken_loading.py:RL007NoFile", "--format", "github")
    assert run.returncode == 3
    assert run.stdout.startswith("::error ")
    assert "RL007" in run.stdout


def test_command_refuses_a_waiver_without_a_reason():
    run = rlctl(f"{HERE}/broken_waivers.py:NoReason", "--select", "RL106")
    assert (run.returncode, run.stdout) == (2, "")
    assert "RL106 is waived without a reason" in run.stderr
