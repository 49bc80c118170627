"""What only shows with real child processes: crashes, hangs, hash order, exit codes, and the two outputs."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from rlctl.checking.check import check, judge
from rlctl.checking.experiment import RecordsJudge
from rlctl.checking.records import Records
from rlctl.checking.rule_index import JUDGES, choose_rules
from rlctl.checking.tool_formats import read_baseline
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, UsageError
from tests import fork_server

FOLDER = Path(__file__).parent
BROKEN = "tests/checking/broken_envs.py"
ROOT = FOLDER.parent.parent


def rlctl(*arguments):
    command = [sys.executable, "-m", "rlctl", "check-env", *arguments]
    return fork_server.for_commands().run(command, cwd=ROOT, timeout=250)


@pytest.fixture
def in_root(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.mark.parametrize(
    ("task", "expected", "message", "fix"),
    [
        ("tests/checking/broken_import.py:RL001Anything", "RL001", "ZeroDivisionError: at import", "Repair the line"),
        (f"{BROKEN}:RaisingConstructor", "RL007", "does not find 'robot.urdf', looked for in", "__file__"),
        pytest.param(
            *(
                "tests/checking/broken_loading.py:NoSearchPath",
                "RL007",
                "call setAdditionalSearchPath first",
                "__file__",
            ),
            marks=pytest.mark.pybullet,
        ),
        (f"{BROKEN}:NeedsArgument", "RL006", "missing 1 required", "(--set task.gain=...)"),
        (f"{BROKEN}:NUMBER", "RL005", "NUMBER is of type int, not a class", "case-sensitive"),
        (
            f"{BROKEN}:RL003NoEnvironment",
            "RL003",
            "is neither a Gymnasium environment",
            "Inherit from gymnasium.Env",
        ),
        (f"{BROKEN}:RL004ExitsWhenBuilt", "RL004", "the process ended with exit code 7 in the constructor", "input"),
    ],
)
def test_without_an_instance_there_is_a_finding_and_exit_code_3(task, expected, message, fix, in_root):
    report = check(EnvSpec(task), env_timeout_s=10)
    (finding,) = report.verdict.findings
    assert finding.rule == expected
    assert message in finding.message
    assert fix in finding.fix
    assert report.exit_code == 3
    assert report.verdict.not_judged["RL301"] == "no instance could be built"


@pytest.mark.slow
def test_segfault_is_a_finding(in_root):
    report = check(EnvSpec(f"{BROKEN}:RL208Segfaults"), env_timeout_s=10)
    (finding,) = report.verdict.findings
    assert (finding.rule, finding.message) == ("RL208", "the process was killed by SIGSEGV in step 7")
    assert finding.evidence["seed"] == 1000
    assert report.exit_code == 1
    assert {"RL301", "RL401", "RL501"} <= report.verdict.not_judged.keys()


@pytest.mark.slow
def test_hang_is_a_finding_after_the_timeout(in_root):
    report = check(
        EnvSpec(f"{BROKEN}:RL209Hangs"), env_timeout_s=0.7
    )  # of its own clock; other calls take microseconds
    (finding,) = report.verdict.findings
    assert (finding.rule, finding.message) == ("RL209", "step 7 did not return within 0.7 s")
    assert report.exit_code == 1


@pytest.mark.slow
def test_a_first_call_that_hangs_ends_the_process_once(in_root):
    report = check(EnvSpec(f"{BROKEN}:HangsAtOnce"), env_timeout_s=0.2)
    (finding,) = report.verdict.findings
    assert (finding.rule, finding.message) == ("RL209", "step 1 did not return within 0.6 s")
    assert [failure.process for failure in report.records.failures] == ["probe", "instances"]


NAN = """
import gymnasium, numpy
class Env(gymnasium.Env):
    observation_space = action_space = gymnasium.spaces.Box(-1, 1, (2,))
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return numpy.zeros(2, numpy.float32), {}
    def step(self, action):
        while not abs(action).sum() < 10:
            pass
        return action, 0.0, False, False, {}
"""


@pytest.mark.slow
def test_what_hangs_for_nan_is_not_called_a_hang(tmp_path):
    (tmp_path / "nan_hangs.py").write_text(NAN)
    rules = choose_rules(["RL209", "RL704"])
    report = check(EnvSpec(f"{tmp_path}/nan_hangs.py:Env"), rules=rules, only=["nan action"], env_timeout_s=0.2)
    (finding,) = report.verdict.findings
    assert (finding.rule, finding.severity) == ("RL704", "info")
    assert finding.message == "after an action of NaN, step 1 did not return within 0.6 s"
    assert report.exit_code == 0


@pytest.mark.slow
def test_printing_is_worth_knowing_and_does_not_reach_the_result(in_root):
    run = rlctl(f"{BROKEN}:RL211Prints", "--select", "RL211", "--json", "-")
    content = json.loads(run.stdout)
    (finding,) = content["findings"]
    assert (finding["rule"], finding["severity"]) == ("RL211", "warning")
    assert "the first: 'moving [" in finding["message"]
    assert run.returncode == 0


@pytest.mark.slow
def test_hash_order_shows_in_a_new_process(in_root):
    report = check(
        EnvSpec("tests/checking/broken_repeats.py:RL305HashOrder"), rules=choose_rules(["RL3"]), env_timeout_s=10
    )
    assert [finding.rule for finding in report.verdict.findings] == ["RL305"]


def test_unknown_names_are_usage_errors(in_root):
    with pytest.raises(UsageError, match=r"no task 'reech'. Did you mean 'reach'\?"):
        check(EnvSpec("reech"), env_timeout_s=10)
    with pytest.raises(UsageError, match=r"no parameter 'sise'. Did you mean 'size'\?"):
        check(EnvSpec(f"{BROKEN}:Clean", {"sise": 1.0}), env_timeout_s=10)
    with pytest.raises(UsageError, match="no module 'nowhere'"):
        check(EnvSpec("nowhere:Env"), env_timeout_s=10)


@pytest.mark.slow
def test_the_tools_own_process_loads_neither_learner_nor_simulator(in_root):
    code = (
        "import sys; from rlctl.checking.check import check; import rlctl.checking.formats; "
        "from rlctl.environments.spec import EnvSpec; "
        "check(EnvSpec('tests/checking/broken_import.py:RL001Anything'), env_timeout_s=10); "
        "print([name for name in ('torch', 'stable_baselines3', 'pybullet', 'broken_import') if name in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=250, check=True)
    assert run.stdout == "[]\n"


def test_a_rule_that_crashes_is_no_pass(monkeypatch):
    for rule in ("RL004", "RL306"):
        monkeypatch.setitem(JUDGES, rule, RecordsJudge(rule, (), False, lambda records: [1 / 0]))
    verdict = judge(Records("any"), ["RL004", "RL306"])
    assert verdict.not_judged["RL306"] == "no instance could be built"
    assert "ZeroDivisionError" in verdict.crashed["RL004"]
    assert verdict.judged == []


@pytest.mark.slow
def test_command_of_a_clean_environment(tmp_path):
    run = rlctl("reach")
    assert (run.returncode, run.stderr) == (0, "")
    lines = run.stdout.splitlines()
    assert re.match(r"reach: no findings; \d\d rules judged in ", lines[0])
    assert len(lines) <= 24
    for expected in ("joint_positions (7)", "hand (3)", "observed", "action Box(-1.0, 1.0, (7,), float32)", "steps/s"):
        assert expected in run.stdout
    assert "not judged" not in run.stdout
    assert "\x1b" not in run.stdout


# Takes a second, and runs in every `make test`: check-env as a command, its report and its exit code.
def test_command_of_a_broken_environment(tmp_path):
    file = tmp_path / "report.json"
    chosen = ["--select", "RL103"]
    run = rlctl(f"{BROKEN}:RL103OftenOutOfRange", "--set", "task.size=4.0", *chosen, "--json", str(file))
    assert run.returncode == 1
    assert run.stdout.startswith("error RL103")
    content = json.loads(file.read_text())
    (finding,) = content["findings"]
    assert finding.keys() == {
        *("rule", "name", "severity", "message", "evidence", "fix", "fingerprint", "file", "line"),
    }
    assert finding["fingerprint"].endswith(finding["evidence"]["element"])
    assert (finding["rule"], finding["severity"]) == ("RL103", "error")
    assert finding["evidence"]["expected"] == [-4.0, 4.0]
    assert content["environment"]["action_space"].startswith("Box(-1.0, 1.0, (2,)")
    assert content["not_judged"] == []


@pytest.mark.slow
def test_a_family_of_rules_and_the_speed(tmp_path):
    file = tmp_path / "report.json"
    run = rlctl(f"{BROKEN}:RL103OftenOutOfRange", "--select", "RL1,RL901", "--json", str(file))
    assert run.returncode == 1
    content = json.loads(file.read_text())
    assert [finding["rule"] for finding in content["findings"]] == ["RL103"]
    assert content["speed"]["steps_per_second"] > 0
    assert content["not_judged"] == []


def test_a_baseline_that_is_a_device_is_refused():
    with pytest.raises(ArtifactError, match="not a file"):
        read_baseline(Path("/dev/zero"))


@pytest.mark.slow
def test_findings_of_the_baseline_fail_nothing(tmp_path):
    task, file = f"{BROKEN}:RL204ArrayReward", str(tmp_path / "report.json")
    assert rlctl(task, "--select", "RL2", "--json", file).returncode == 1
    run = rlctl(task, "--select", "RL2", "--baseline", file)
    assert run.returncode == 0
    assert "no findings, 1 known from the baseline" in run.stdout
    run = rlctl(task, "--select", "RL2", "--baseline", str(tmp_path / "none.json"))
    assert (run.returncode, run.stdout) == (5, "")


@pytest.mark.slow
def test_command_shows_the_worst_first_with_numbers_and_fix():
    run = rlctl(f"{BROKEN}:RL204ArrayReward", "--select", "RL2")
    assert run.returncode == 1
    assert run.stdout.splitlines()[:4] == [
        "error RL204  types of what step returns",
        "  the reward is a numpy.ndarray at step 1",
        "  seed 1000, episode 0, actions random, step 1, call step, type numpy.ndarray, expected float",
        "  fix: Return bool(...) for both flags (a comparison of numpy numbers gives numpy.bool), float(reward), and a "
        "dict, which may be empty.",
    ]


@pytest.mark.slow
def test_command_of_mistakes_in_the_command():
    run = rlctl("CartPole-v99")
    assert run.returncode == 2
    assert run.stdout == ""
    run = rlctl(f"{BROKEN}:NeedsArgument", "--json", "-")
    assert run.returncode == 3
    assert json.loads(run.stdout)["findings"][0]["rule"] == "RL006"
