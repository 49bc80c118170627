"""Attributes, pictures, windows, and ends of episodes."""

from pathlib import Path

import pytest

from rlctl.checking.check import check
from rlctl.checking.rule_index import RULES
from rlctl.environments.spec import EnvSpec
from tests.checking.judging import case, check_case, findings, found, mark_slow, verdict_of

FILE = "broken_interface.py"
CASES = [
    case(f"{FILE}:RL404NewSpaces", ("RL404", "warning"), slow=True),
    case(f"{FILE}:RL215TakesNoMode", ("RL215", "warning"), twin=f"{FILE}:Renders"),
    case(f"{FILE}:RL215RenderRaises", ("RL215", "warning"), twin=f"{FILE}:Renders"),
    case(f"{FILE}:RL215RenderNeedsGraphics", ("RL215", "info"), twin=f"{FILE}:Renders"),
    case(f"{FILE}:RL215RenderFloats", ("RL215", "warning"), twin=f"{FILE}:Renders"),
    case(f"{FILE}:RL215RenderNothing", ("RL215", "warning"), twin=f"{FILE}:Renders"),
    case(f"{FILE}:WindowByDefault", ("RL216", "error"), twin=f"{FILE}:DrawsInWindow"),
    case(f"{FILE}:RL506Falls", ("RL506", "warning"), twin=f"{FILE}:RL506FallsInTime"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


def messages(name, rule):
    return [each.message for each in findings(f"{FILE}:{name}", rule)]


def test_a_space_that_is_made_anew_is_named():
    assert messages("RL404NewSpaces", "RL404") == [
        "action_space is a new object each time it is read, so that seeding it has no effect"
    ]


def test_pictures_are_told():
    (message,) = messages("RL215RenderFloats", "RL215")
    assert message == (
        "with render_mode='rgb_array' render returns an array of float64 and shape (20, 30, 3), not a uint8 array of "
        "shape (height, width, 3)"
    )
    (message,) = messages("RL215TakesNoMode", "RL215")
    assert message.startswith("metadata lists the render mode rgb_array, but ")
    assert message.endswith("takes no render_mode")
    (message,) = messages("RL215RenderNothing", "RL215")
    assert message.startswith("with render_mode='rgb_array' render returns a NoneType")


def test_a_window_that_raises_is_told_as_a_window():
    """Not RL207 and RL002, which would advise to repeat the episode or the constructor."""
    (finding,) = findings(f"{FILE}:WindowByDefault", "RL207", "RL216")
    assert finding.rule == "RL216"
    assert finding.message.startswith("reset raised RuntimeError: No available video device (")
    assert finding.message.endswith("): it opens a window")
    (finding,) = findings(f"{FILE}:WindowInConstructor", "RL002", "RL216")
    assert finding.rule == "RL216"
    assert "NoSuchDisplayException: Cannot connect to" in finding.message


@pytest.mark.slow
def test_gymnasiums_own_generator_has_no_place():
    (finding,) = findings(f"{FILE}:ForgetsSeed", "RL311")
    assert finding.message.startswith("self._np_random is used")
    assert finding.where is None


def test_a_generator_from_which_a_reset_draws_more_or_less_is_seeded():
    assert found("broken_repeats.py:RL301StartsElsewhere", "RL311") == set()


@pytest.mark.slow
def test_types_have_an_article():
    assert messages("CountsAsFlag", "RL204") == ["terminated is an int at step 1"]


def test_a_library_that_is_not_installed_is_not_the_environments_fault():
    verdict = verdict_of(f"{FILE}:RenderWithoutLibrary", "RL215")
    assert verdict.findings == []
    assert "library_for_pictures" in verdict.not_judged["RL215"]


def test_a_reset_that_raises_is_no_failure_of_rendering():
    verdict = verdict_of(f"{FILE}:ResetRaises", "RL207", "RL215")
    assert [finding.rule for finding in verdict.findings] == ["RL207"]
    assert "RuntimeError: no world" in verdict.not_judged["RL215"]


def test_no_limit_is_told_with_what_is_known():
    (message,) = messages("RL506Falls", "RL506")
    assert message.startswith(
        "no time limit was seen: step always returns truncated=False; all 16 episodes ended with "
    )


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize(
    ("name", "rule", "severity", "text"),
    [
        ("RL216Gui", "RL216", "error", "PyBullet opens a window (p.GUI, tests/checking/broken_interface.py:"),
        ("GuiInReset", "RL216", "error", "in reset, because there is no display: 'cannot connect to X server'"),
    ],
)
def test_what_ends_the_process_is_said_once(name, rule, severity, text, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    wanted = ["RL004", "RL208", "RL216", "RL403"]
    task = str(Path(__file__).parent / FILE) + f":{name}"
    report = check(EnvSpec(task), env_timeout_s=10, rules=wanted)
    (finding,) = report.verdict.findings
    assert (finding.rule, finding.severity) == (rule, severity)
    assert text in finding.message


@pytest.mark.slow
def test_what_ends_the_process_leaves_nothing_else_unjudged():
    """Another process does what comes after asking for rewards, which ends the first."""
    task = str(Path(__file__).parent / "broken_goals.py") + ":EndsInComputeReward"
    verdict = check(EnvSpec(task), env_timeout_s=10, rules=["RL208", "RL405", "RL614"]).verdict
    (finding,) = verdict.findings
    assert (finding.rule, finding.severity) == ("RL208", "error")
    assert finding.message == "the process ended with exit code 9 in compute_reward"
    assert (verdict.judged, verdict.not_judged.keys()) == (["RL208", "RL405"], {"RL614"})


@pytest.mark.slow
def test_what_ends_the_process_while_rendering_is_an_error():
    task = str(Path(__file__).parent / FILE) + ":EndsInRender"
    (finding,) = check(EnvSpec(task), env_timeout_s=10, rules=["RL208", "RL215"]).verdict.findings
    assert (finding.rule, finding.severity) == ("RL215", "error")
    assert finding.message == "rendering without a window: the process ended with exit code 9 in render"


@pytest.mark.slow
def test_flags_per_agent_are_of_a_wrong_type_and_end_nothing():
    verdict = verdict_of(f"{FILE}:FlagsPerAgent", "RL204", "RL502", "RL504")
    assert [finding.rule for finding in verdict.findings] == ["RL204", "RL204"]


@pytest.mark.slow
def test_an_exception_in_a_library_is_placed_at_its_call(tmp_path, monkeypatch):
    (tmp_path / "site-packages").mkdir()
    (tmp_path / "site-packages" / "grippers.py").write_text("def close():\n    raise ValueError('no gripper')\n")
    monkeypatch.syspath_prepend(tmp_path / "site-packages")
    file = tmp_path / "gripping.py"
    file.write_text(
        "import grippers\n\nfrom tests.checking.broken_envs import Clean\n\n\n"
        "class Gripping(Clean):\n    def start(self):\n        super().start()\n        grippers.close()\n"
    )
    (finding,) = findings(f"{file}:Gripping", "RL207")
    assert finding.where == (str(file), 9)
    assert finding.message == "reset raised ValueError: no gripper (gripping.py:9)"


@pytest.mark.slow
def test_missing_opengl_is_fixed_by_another_backend_and_other_exceptions_by_repair():
    (finding,) = findings(f"{FILE}:LacksOpenGL", "RL207")
    assert "set MUJOCO_GL=egl (or osmesa)" in finding.fix
    (finding,) = findings(f"{FILE}:RaisesInStart", "RL207")
    assert finding.fix == RULES["RL207"].fix
