"""`rlctl check-env TASK --audit`: exit codes, the table in a pipe, JSON; and what it says of a run."""

import json

import pytest

from tests.checking.audit import mistakes

FILE = mistakes.__file__


@pytest.mark.pybullet
@pytest.mark.slow
def test_a_mistake_is_said_in_a_line_and_exits_with_1(rlctl, tmp_path):
    arguments = ("check-env", f"{FILE}:EndsAtTheGoal", "--audit", "--json", "audit.json")
    done = rlctl(*arguments)
    assert done.returncode == 1, done.stderr
    first, _, columns, best, *_ = done.stdout.splitlines()
    assert "hovering beside the goal earns more than reaching the goal (" in first
    assert first.endswith("; near pays it")
    assert columns.split() == ["who", "return", "success", "steps", "near", "reached", "action"]
    assert best.startswith("hovering beside the goal ")
    content = json.loads((tmp_path / "audit.json").read_text())
    assert content["format"] == "rlctl check-env audit 1"
    assert content["wanted"] == "reaching the goal"
    assert content["beaten"][0]["term"] == "near"
    assert {one["kind"] for one in content["competitors"]} == {"wanted", "moved", "idle", "part"}


@pytest.mark.pybullet
@pytest.mark.slow
def test_a_sound_reward_exits_with_0(rlctl):
    done = rlctl("check-env", f"{FILE}:StaysAtTheGoal", "--audit")
    assert done.returncode == 0, done.stderr
    assert ": nobody earns as much as reaching the goal; next is hovering beside the goal with " in done.stdout


@pytest.mark.slow
def test_a_plain_environment_has_a_ranking_alone(rlctl):
    done = rlctl("check-env", "CartPole-v1", "--audit")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("CartPole-v1: ranking alone: ")
    assert "trembling" in done.stdout


@pytest.mark.slow
def test_options_of_rules_are_refused(rlctl):
    done = rlctl("check-env", "reach", "--audit", "--select", "RL6")
    assert done.returncode == 2
    assert "--audit judges no rules" in done.stderr


@pytest.mark.slow
def test_who_cannot_be_played_exits_with_3(rlctl, tmp_path):
    (tmp_path / "broken.py").write_text(
        "import gymnasium\nclass Broken(gymnasium.Env):\n    def __init__(self): 1 / 0\n"
    )
    done = rlctl("check-env", "broken.py:Broken", "--audit")
    assert done.returncode == 3
    assert "ZeroDivisionError" in done.stderr
    assert "Traceback" not in done.stderr
