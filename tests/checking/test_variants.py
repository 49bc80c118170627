"""RL0, variants: the events and the stages of a task."""

import pytest

from tests.checking.judging import FOLDER, case, check_case, findings, mark_slow, records_of

ERROR = "error"
SOUND = "broken_variants.py:Sound"
CASES = [
    case("broken_variants.py:RL011WrongBody", ("RL011", ERROR), twin=SOUND, slow=True),
    case("broken_variants.py:RL011OwnChance", ("RL011", ERROR), twin=SOUND, slow=True),
    case(
        "broken_variants.py:RL011BreaksDown", ("RL011", ERROR), twin="broken_variants.py:RL011NeedsItsEvents", slow=True
    ),
    case(
        "broken_variants.py:RL014ForgetsTheMass",
        ("RL014", "warning"),
        twin="broken_variants.py:RL014AppliesTheMass",
        slow=True,
    ),
    case(
        "broken_variants.py:RL014ActsTooLate",
        ("RL014", "warning"),
        twin="broken_variants.py:RL014ActsInTime",
        slow=True,
    ),
    case(
        "broken_variants.py:RL014PushesTheStand",
        ("RL014", "warning"),
        twin="broken_variants.py:RL014ActsInTime",
        slow=True,
    ),
    case(
        "broken_variants.py:RL014WeighsTheStand",
        ("RL014", "warning"),
        twin="broken_variants.py:RL014AppliesTheMass",
        slow=True,
    ),
    case("broken_variants.py:RL013Misspelled", ("RL013", "warning"), twin=SOUND),
    case("broken_variants.py:RL012WrongKey", ("RL012", ERROR), twin=SOUND, slow=True),
    case("broken_variants.py:RL012WrongParameter", ("RL012", ERROR), twin=SOUND, slow=True),
    case("broken_variants.py:RL012WrongEvent", ("RL012", ERROR), twin=SOUND, slow=True),
    case("broken_variants.py:RL012OtherSpaces", ("RL012", ERROR), twin=SOUND, slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rule", "message"),
    [
        ("RL011WrongBody", "RL011", "with randomize=true: events.mass: no body 'amr'. Did you mean 'arm'? "),
        ("RL011OwnChance", "RL011", "with randomize=true: equal seeds and actions give unequal episodes"),
        (
            "RL011BreaksDown",
            "RL011",
            "with randomize=true: RuntimeError: a gear broke (tests/checking/broken_variants.py:",
        ),
        ("RL012WrongKey", "RL012", "stages: stage 1: no key 'taks'. Did you mean 'task'?"),
        (
            "RL012WrongParameter",
            "RL012",
            "stage 1 of 2: task.tolerence: RL012WrongParameter has no parameter 'tolerence'.",
        ),
        ("RL012WrongEvent", "RL012", "stage 2 of 2: events: this task has no event 'masss'. Did you mean 'mass'?"),
        ("RL012OtherSpaces", "RL012", "stage 2 of 2: its observation space is Box"),
    ],
)
def test_what_is_wrong_is_named(name, rule, message):
    (finding,) = findings(f"broken_variants.py:{name}", rule)
    assert finding.message.startswith(message), finding.message


def test_names_that_have_no_effect_are_found():
    assert {finding.message for finding in findings("broken_variants.py:RL013Misspelled", "RL013")} == {
        "nothing uses RL013Misspelled.episode_seconds. Did you mean 'episode_s'?",
        "nothing uses RL013Misspelled.is_terminate. Did you mean 'is_terminated'?",
    }


def test_a_base_class_in_another_module_may_use_a_name():
    assert findings("rlctl_locomotion.humanoid_walk:HumanoidWalk", "RL013") == []


@pytest.mark.slow
def test_a_task_that_randomises_is_judged_so(rlctl):
    task = f"{FOLDER}/broken_variants.py:RL011BreaksDown"
    done = rlctl("check-env", task, "--select", "RL011,RL301", "--set", "randomize=true")
    assert "not judged: RL011: the task raises with and without its events (RL2)" in done.stdout
    assert "not judged: RL301: the episode failed (RL201, RL207)" in done.stdout


@pytest.mark.slow
def test_an_error_of_the_task_layer_is_named_as_one():
    (finding,) = findings("broken_variants.py:NotFinite", "RL207")
    assert finding.message == "step 1 raised TaskError: NotFinite: reward term 'distance' is nan at step 1"


@pytest.mark.slow
def test_stages_of_a_packaged_recipe_are_judged(tmp_path, write_module):
    task = write_module("swing.py", "from rlctl_manipulation.reach import Reach\nclass Swing(Reach): pass\n")
    task.with_suffix(".yaml").write_text("stages: [{task: {episode: 1}, promote: {success: 0.5}}, {}]\n")
    (finding,) = findings(f"{task}:Swing", "RL012")
    assert finding.message.startswith("stage 1 of 2: task.episode: Swing has no parameter 'episode'.")


def test_a_plain_environment_has_neither():
    records = records_of("broken_envs.py:Clean", "variants")
    assert not records.findings
