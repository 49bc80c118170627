"""A mirror symmetry that a task declares is compared with the simulation."""

import pytest

from rlctl.engine import MUJOCO
from rlctl.errors import TaskError
from rlctl.task.env import TaskEnv
from rlctl_locomotion.walk import Walk
from tests.checking.judging import case, check_case, findings, found, mark_slow, verdict_of

pytest.importorskip("mujoco")

FILE = "broken_mirrors.py"
TWIN = f"{FILE}:RL120MirrorsTurning"
CASES = [
    case(f"{FILE}:RL120MirrorsTurningLikeVectors", ("RL120", "error"), twin=TWIN, slow=True),
    case(f"{FILE}:RL120TurnsHipsTheSameWay", ("RL120", "error"), twin=TWIN),
    case(f"{FILE}:RL120PrefersItsLeft", ("RL120", "error"), twin=f"{FILE}:MeasuresItsLeft"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow_except("walk")
@pytest.mark.parametrize(
    "task", ["walk", "walk-rough", "walk-stairs", "get-up", "humanoid-walk", "mini-walk", "quadruped-bow"]
)
def test_sound_declarations(task):
    assert found(task, "RL120") == set()


@pytest.mark.slow
def test_robots_that_are_drawn_with_unequal_sides(rlctl):
    """The motors of both sides draw their own values: the robots differ, and all of them together are symmetric."""
    done = rlctl("check-env", "mini-walk", "--select", "RL120", "--set", "randomize=true")
    assert (done.returncode, "no findings" in done.stdout) == (0, True)


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("RL120MirrorsTurningLikeVectors", "after 1 step from a mirrored state, with mirrored actions, gyroscope["),
        ("RL120TurnsHipsTheSameWay", "at the start from a mirrored state"),
        ("RL120PrefersItsLeft", "after 1 step from a mirrored state, with mirrored actions, reward term tracking is"),
    ],
)
def test_the_message_names_what_is_wrong(name, message):
    (finding,) = findings(f"{FILE}:{name}", "RL120")
    assert finding.message.startswith(message)


def test_tasks_without_a_symmetry():
    assert verdict_of("broken_batches.py:Point", "RL120").not_applicable == {"RL120": "it declares no mirror symmetry"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"gravity": (1, 2)},
            r"'gravity' has 3 elements, so each number from 1 to 3 is needed once, with a sign; got \[1, 2\]",
        ),
        ({"gravitiy": (1, -2, 3)}, "Walk: mirror: nothing is called 'gravitiy'. Did you mean 'gravity'?"),
    ],
)
def test_declarations_that_do_not_fit(changes, message, monkeypatch):
    monkeypatch.setattr(Walk, "mirror", {**Walk.mirror, **changes})
    with pytest.raises(TaskError, match=message):
        TaskEnv(Walk(), sim=MUJOCO)


def test_an_observation_without_an_entry(monkeypatch):
    monkeypatch.setattr(Walk, "mirror", {"action": Walk.mirror["action"]})
    with pytest.raises(
        TaskError, match="mirror: 'gyroscope' is missing; each observation and the action need an entry"
    ):
        TaskEnv(Walk(), sim=MUJOCO)
