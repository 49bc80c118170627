"""Environments that nobody here wrote: what is found there is true, and worth the severity it is reported with.

`third_party.yaml` has every environment with its findings and the severity that each deserves, judged by reading the
environment's source. One check takes 10 to 40 seconds, all of them about an hour on two cores.
"""

import collections
import dataclasses
import functools
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

pytestmark = pytest.mark.slow

HERE = Path(__file__).parent
REQUIREMENTS = HERE / "third_party.txt"
GROUPS = yaml.safe_load((HERE / "third_party.yaml").read_text())
EVERYWHERE = GROUPS.pop("everywhere")
JUDGED = {task: rules or {} for group in GROUPS.values() for task, rules in group.items()}
GYMNASIUM = list(GROUPS["gymnasium"])
LOST = 3
"""How many findings that deserve a warning or an error may stay unreported."""
REPEATED = (
    *("LunarLander-v3", "panda_gym:PandaPush-v3", "stable_baselines3.common.envs:IdentityEnvBox"),
    *("gym_electric_motor:Cont-CC-PMSM-v0", "lanro_with_logger:PandaNLReach2-v0"),
)

# lanro-gym calls a function that Gymnasium 1.0 removed; nothing else of it is touched.
LANRO = "import gymnasium.logger\ngymnasium.logger.set_level = lambda level: None\nimport lanro_gym\n"

SEVERITIES = ("info", "warning", "error")


@dataclasses.dataclass(frozen=True)
class Result:
    """One run of check-env."""

    exit_code: int
    crashed: list
    findings: frozenset
    """Of (rule, severity), each once: a rule that reports three leaves is one thing to read about."""
    seconds: float


def deserved(task, rule):
    """Return the severity that a finding deserves: one of `SEVERITIES`, `false`, or `unjudged`."""
    return JUDGED[task].get(rule, EVERYWHERE.get(rule, "unjudged")).split(",")[0].removesuffix("?")


def verdict(severity, deserved_severity):
    """Say of a reported finding: true, pedantic (correct, and reported too loudly), false or unjudged."""
    if deserved_severity in ("false", "unjudged"):
        return deserved_severity
    return "true" if SEVERITIES.index(deserved_severity) >= SEVERITIES.index(severity) else "pedantic"


def count_verdicts(results):
    """Count what was reported, by severity and verdict."""
    return collections.Counter(
        (severity, verdict(severity, deserved(task, rule)))
        for task, result in results.items()
        for rule, severity in result.findings
        if severity != "info"
    )


def true_share(counts, severity):
    """Return how much of what was reported with a severity is true and worth it. Shape: a number in 0..1."""
    total = sum(count for (reported, _), count in counts.items() if reported == severity)
    return counts[severity, "true"] / total if total else 1.0


def find_lost(results):
    """Return (task, rule) of what deserves an error or a warning and is not reported as either."""
    return [
        (task, rule)
        for task, result in results.items()
        for rule, judgement in JUDGED[task].items()
        if judgement.split(",")[0] in SEVERITIES[1:]
        and not any(rule == found and severity != "info" for found, severity in result.findings)
    ]


def format_table(results):
    """Write a line per environment and the counts below."""
    lines = []
    for task, result in results.items():
        findings = " ".join(
            f"{severity[0].upper()}:{rule}:{verdict(severity, deserved(task, rule))}"
            for rule, severity in sorted(result.findings, key=lambda each: (each[1], each[0]))
            if severity != "info"
        )
        lines.append(f"{task:60} {result.exit_code:3} {result.seconds:5.1f} s  {findings}")
    counts = count_verdicts(results)
    for severity in ("error", "warning"):
        row = ", ".join(f"{counts[severity, word]} {word}" for word in ("true", "pedantic", "false", "unjudged"))
        lines.append(f"{severity}s: {row}: {true_share(counts, severity):.1%} true and worth it")
    codes = collections.Counter(result.exit_code for result in results.values())
    lines.append("exit codes: " + ", ".join(f"{count} x {code}" for code, count in sorted(codes.items())))
    lines.append(f"median {statistics.median(result.seconds for result in results.values()):.1f} s")
    lines.append("not reported as a warning or an error: " + ", ".join(map(" ".join, find_lost(results))))
    return "\n".join(lines)


def read_result(exit_code, report):
    """Take what matters here from a report in JSON."""
    findings = frozenset((finding["rule"], finding["severity"]) for finding in report["findings"])
    return Result(exit_code, report["crashed"], findings, report["seconds"])


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    """A folder with the packages, for PYTHONPATH."""
    folder = tmp_path_factory.mktemp("third_party")
    command = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", folder, "-r", REQUIREMENTS]
    subprocess.run(command, check=True, timeout=1800)
    (folder / "lanro_with_logger.py").write_text(LANRO)
    return folder


@pytest.fixture(scope="module")
def run_check(packages, tmp_path_factory):
    """A function from an environment to the result of one more check of it."""

    def run(task):
        folder = tmp_path_factory.mktemp("check")  # some write files beside themselves
        command = [sys.executable, "-m", "rlctl", "check-env", *task.split(), "--json", "report.json"]
        environ = {**os.environ, "PYTHONPATH": str(packages)}
        done = subprocess.run(
            command, cwd=folder, env=environ, capture_output=True, text=True, timeout=600, check=False
        )
        assert done.returncode in (0, 1, 3), done.stderr
        return read_result(done.returncode, json.loads((folder / "report.json").read_text()))

    return run


@pytest.fixture(scope="module")
def check_once(run_check):
    """The same, with the result of the first check kept."""
    return functools.cache(run_check)


@pytest.mark.parametrize("task", JUDGED)
def test_nothing_crashes_and_no_error_is_false(task, check_once):
    result = check_once(task)
    assert result.crashed == []
    errors = {rule: deserved(task, rule) for rule, severity in result.findings if severity == "error"}
    assert not {rule for rule, word in errors.items() if word == "false"}


@pytest.mark.parametrize("task", GYMNASIUM)
def test_gymnasiums_own_pass(task, check_once):
    assert check_once(task).exit_code == 0


def test_what_is_reported_is_worth_it(check_once, capsys):
    results = {task: check_once(task) for task in JUDGED}
    with capsys.disabled():
        print("\n" + format_table(results))
    counts = count_verdicts(results)
    assert true_share(counts, "error") >= 0.95
    assert true_share(counts, "warning") >= 0.75
    assert len(find_lost(results)) <= LOST


@pytest.mark.parametrize("task", REPEATED)
def test_five_checks_find_the_same(task, run_check):
    assert len({run_check(task).findings for _ in range(5)}) == 1
