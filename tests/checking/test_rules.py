"""Each rule finds its mistake, and only that; `Clean` and its like come out clean.

Lives the environments in this process; what needs a process of its own is in `test_processes.py`.
"""

import ast
import re
import subprocess
import sys
from importlib import import_module

import pytest

from rlctl.checking.experiment import index
from rlctl.checking.rule_index import EXPERIMENTS, PROCESSES, RULES, find_modules, find_needs
from rlctl.checking.values import find_numbers, name_numbers
from tests.checking.judging import (
    FOLDER,
    case,
    check_case,
    findings,
    found,
    list_cases,
    mark_slow,
    records_of,
    verdict_of,
)

CASES = [
    case("broken_envs.py:RL003OldGym", ("RL003", "error"), ("RL201", "error"), ("RL202", "error")),
    case("broken_envs.py:RL101WrongShape", ("RL101", "error")),
    case("broken_envs.py:RL101MissingKey", ("RL101", "error")),
    case("broken_envs.py:RL102Float64", ("RL102", "warning")),
    case("broken_envs.py:RL103OutOfRange", ("RL103", "warning"), slow=True),
    case("broken_envs.py:RL103OutOfRangeAtReset", ("RL103", "error"), slow=True),
    case("broken_envs.py:RL103OftenOutOfRange", ("RL103", "error")),
    case("broken_envs.py:RL103LastOutOfRange", ("RL103", "info")),
    case("broken_envs.py:RL103Rounding", ("RL103", "warning")),
    case("broken_envs.py:RL103OftenSlightlyOutOfRange", ("RL103", "warning"), slow=True),
    case("broken_envs.py:RL104NanObservation", ("RL104", "error")),
    case("broken_envs.py:RL104Diverges", ("RL104", "error")),
    case("broken_envs.py:RL105ReusedMemory", ("RL105", "info"), slow=True),
    case("broken_envs.py:RL106UnboundedActions", ("RL106", "error")),
    case("broken_envs.py:RL106WideActions", ("RL106", "info")),
    case("broken_spaces.py:RL108OddImage", ("RL108", "warning"), slow=True),
    case("broken_spaces.py:RL108FloatPicture", ("RL108", "warning"), twin="broken_spaces.py:RL108Tiles", slow=True),
    case("broken_spaces.py:RL108TwoAxes", ("RL108", "warning"), twin="broken_spaces.py:RL108FloatTable", slow=True),
    case("broken_spaces.py:RL108Dark", ("RL108", "warning"), twin="broken_spaces.py:RL108Seen", slow=True),
    case("broken_spaces.py:RL106Asymmetric", ("RL106", "warning")),
    case("broken_spaces.py:RL106OwnBox", ("RL106", "warning")),
    case("broken_spaces.py:RL106Thrust", ("RL106", "info")),
    case("broken_spaces.py:RL109TupleObservation", ("RL109", "warning")),
    case("broken_spaces.py:RL109TextObservation", ("RL109", "warning")),
    case("broken_spaces.py:RL109CountsFromOne", ("RL109", "warning")),
    case("broken_envs.py:RL201FourValues", ("RL201", "error")),
    case("broken_envs.py:RL202NoSeed", ("RL202", "error")),
    case("broken_envs.py:RL203NoOptions", ("RL203", "warning")),
    case("broken_envs.py:RL204NumpyBool", ("RL204", "info"), slow=True),
    case("broken_envs.py:RL204ArrayReward", ("RL204", "error")),
    case("broken_envs.py:RL204Float32Reward", ("RL204", "info")),
    case("broken_envs.py:RL204NoneInfo", ("RL204", "error")),
    case("broken_envs.py:RL204SuccessIsADistance", ("RL204", "warning")),
    case("broken_envs.py:RL207Raises", ("RL207", "error")),
    case("broken_envs.py:RL207Exits", ("RL207", "error")),
    case("broken_repeats.py:RL301RL309GlobalRandom", ("RL301", "error"), ("RL309", "warning")),
    case("broken_repeats.py:RL302NoisyStep", ("RL302", "error"), ("RL309", "warning")),
    case("broken_repeats.py:RL301StartsElsewhere", ("RL301", "error")),
    case("broken_repeats.py:RL303LeakyReset", ("RL303", "error")),
    case("broken_repeats.py:RL304ClassCounter", ("RL304", "error"), slow=True),
    *(
        case(f"broken_unseeded.py:{name}", ("RL312", "warning"), twin=twin, **settings)
        for name, twin, settings in (
            ("RL312BoatSeedsWithZero", "robots.py:Boat", {"pybullet": True}),
            ("RL312DroneSeedsAgain", "broken_meaning.py:Drone", {"pybullet": True, "slow": True}),
            ("RL312ArmSeedsWithZero", "mujoco_robots.py:MujocoArm", {"pybullet": True, "slow": True}),
            ("RL312PusherSeedsAgain", "robots.py:Pusher", {"pybullet": True, "slow": True}),
        )
    ),
    case("broken_repeats.py:RL306FixedStart", ("RL306", "info"), slow=True),
    case("broken_repeats.py:RL308UnseededLater", ("RL308", "warning")),
    case("broken_repeats.py:RL301OldActionsAsRegistered", ("RL301", "error")),
    case("broken_repeats.py:RL301Residue", ("RL301", "warning")),
    case(
        "broken_repeats.py:RL401RL808SharedWorld",
        ("RL401", "error"),
        ("RL402", "error"),
        ("RL808", "error"),
        pybullet=True,
        slow=True,
    ),
    case("broken_repeats.py:RL402CloseBreaks", ("RL402", "error")),
    case("broken_repeats.py:RL403OnlyOne", ("RL403", "error")),
    case("broken_envs.py:RL501TimeLimitTerminates", ("RL501", "warning"), slow=True),
    case("broken_envs.py:RL502BothFlags", ("RL502", "error")),
    case("broken_envs.py:RL503Endless", ("RL503", "warning"), slow=True),
    case("broken_envs.py:RL504EndsAtOnce", ("RL504", "warning")),
    case("broken_envs.py:RL504EndsAtStepTwo", ("RL504", "warning")),
    case("broken_envs.py:RL601NanReward", ("RL601", "error")),
    case("broken_goals.py:RL614OtherReward", ("RL614", "error"), twin="broken_goals.py:Goal", slow=True),
    case("broken_goals.py:RL614OneByOne", ("RL614", "error"), twin="broken_goals.py:RL614RoundedReward"),
    case("broken_goals.py:RL614NanComputed", ("RL614", "error")),
    case("broken_goals.py:RL614NumberlessReward", ("RL614", "error"), twin="broken_goals.py:RL614NestedGoal"),
    case("broken_hindsight.py:RL614RoverOwnGoal", ("RL614", "error"), twin="broken_hindsight.py:RL614RoverSeeks"),
    case(
        "broken_hindsight.py:RL614RoverParksMirrored", ("RL614", "warning"), twin="broken_hindsight.py:RL614RoverParks"
    ),
    case(
        "broken_hindsight.py:RL614ArmOwnGoal",
        ("RL614", "error"),
        twin="broken_hindsight.py:RL614ArmSparse",
        slow=True,
    ),
    case(
        "broken_hindsight.py:RL614ReacherOwnGoal",
        ("RL614", "error"),
        twin="broken_hindsight.py:RL614ReacherSeeks",
        pybullet=True,
        slow=True,
    ),
]


def test_a_second_judge_of_a_rule_is_no_silent_replacement():
    with pytest.raises(ValueError, match=r"^RL104: two of str; one is enough$"):
        index([("RL103", "a"), ("RL104", "a"), ("RL104", "b")])


@pytest.mark.parametrize("process", PROCESSES)
def test_a_child_imports_all_parts_of_its_experiments_and_no_others(process):
    modules = find_modules(PROCESSES[process])
    code = (
        "import sys; from rlctl.checking.experiment import import_experiments; "
        f"print({{name: one.rules for name, one in import_experiments({modules}).items()}}); "
        "print([name for name in sys.modules if '.rules.rl' in name and name not in sys.argv[1:]])"
    )
    command = [sys.executable, "-c", code, *modules]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    found = ast.literal_eval(printed[0])
    assert {name: found[name] for name in PROCESSES[process]} == {
        name: EXPERIMENTS[name].rules for name in PROCESSES[process]
    }
    assert ast.literal_eval(printed[1]) == []


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.parametrize(
    "name",
    [
        "broken_envs.py:Clean",
        pytest.param("broken_envs.py:CleanDict", marks=pytest.mark.slow),
        pytest.param("broken_repeats.py:FixedStartNoise", marks=pytest.mark.slow),
        pytest.param("broken_repeats.py:OwnWorld", marks=[pytest.mark.slow, pytest.mark.pybullet]),
        pytest.param("reach", marks=pytest.mark.slow),  # in test_processes.py by the command
    ],
)
def test_clean_is_clean(name):
    verdict = verdict_of(name)
    assert verdict.findings == []
    assert verdict.not_judged == {}
    assert {*verdict.judged, *verdict.not_applicable} == set(RULES)


OTHERS = [
    "Pendulum-v1",
    "Blackjack-v1",
    "MountainCar-v0",
    "MountainCarContinuous-v0",
    "Acrobot-v1",
    "Taxi-v4",
    "CliffWalking-v1",
]


@pytest.mark.slow
@pytest.mark.parametrize(
    "task",
    ["FrozenLake-v1", *(pytest.param(task, marks=pytest.mark.slow) for task in OTHERS)],
)
def test_gymnasiums_own_environments_have_no_errors(task):
    assert not {severity for _, severity in found(task)} & {"error"}


def test_hindsight_rewards_are_compared():
    (finding,) = findings("broken_goals.py:RL614OtherReward", "RL614")
    # Each reward is 0.5 below what compute_reward says.
    assert finding.evidence["value"] - finding.evidence["expected"] == pytest.approx(0.5)


@pytest.mark.slow_except("LosesItsGoal")
@pytest.mark.parametrize("name", ["NoReward", "LosesItsGoal"])
def test_hindsight_rewards_that_cannot_be_compared_are_the_matter_of_other_rules(name):
    verdict = verdict_of(f"broken_goals.py:{name}", "RL614")
    assert verdict.not_judged == {
        "RL614": "goals are missing or change their shape (RL101), or types are wrong (RL204)"
    }


def test_of_asymmetric_actions_the_worst_is_named():
    (finding,) = findings("broken_spaces.py:MoreAndMoreAsymmetric", "RL106")
    assert finding.message == "2 of 2 actions are not symmetric: action[1] is in [-0.1, 1]"


def test_wrappers_take_a_seed_for_an_environment_that_takes_none():
    """Gymnasium's pass it on. What that raises is RL202's only, and no failure of the picture."""
    rules = "RL202", "RL203", "RL207", "RL215"
    assert found("broken_envs.py:no_seed_in_a_wrapper", *rules) == {("RL202", "error")}
    assert found("broken_envs.py:seed_of_a_wrapper", *rules) == set()


def test_a_number_that_is_too_large_for_a_float_is_left_out():
    assert dict(find_numbers({"hash": 10**400, "terms": {"hash": 10**400, "distance": 1}})) == {"terms/distance": 1.0}


@pytest.mark.parametrize(
    ("first", "count", "name"),
    [
        (0, 1, "observation['joints'][0]"),
        (4, 2, "observation['joints'][4:6]"),
        (6, 3, "observation['goal'][0:3]"),
        (5, 2, "observation['joints'][5] and observation['goal'][0]"),
    ],
)
def test_numbers_of_an_observation_are_named_by_their_array(first, count, name):
    assert name_numbers([("observation['joints']", 6), ("observation['goal']", 3)], first, count) == name


@pytest.mark.slow
def test_out_of_range_is_placed():
    (finding,) = findings("broken_envs.py:RL103OutOfRange", "RL103")
    assert re.match(
        r"observation\[[01]\] is [\d.]+ at step 30; the space allows \[-5, 5\]; \d+ of \d+ observations are outside",
        finding.message,
    )
    assert finding.evidence["step"] == 30
    assert finding.evidence["expected"] == [-5.0, 5.0]
    assert finding.evidence["value"] > 5.0
    assert {"seed", "episode"} <= finding.evidence.keys()


def test_exception_is_placed():
    (finding,) = findings("broken_envs.py:RL207Raises", "RL207")
    assert finding.message.startswith("step 7 raised RuntimeError: joint 3 is gone (tests/checking/broken_envs.py:")
    assert finding.evidence["step"] == 7
    assert finding.evidence["seed"] == 1000


def test_names_of_a_tasks_observation_are_used():
    built = records_of("reach", "build").built
    # 7 joint positions, 7 velocities, then the hand.
    assert built.element(0, 15) == "hand[1]"
    assert built.max_steps == 120


def test_difference_is_named():
    (finding,) = findings("broken_repeats.py:RL301RL309GlobalRandom", "RL301")
    assert finding.message.startswith("reset twice with one seed: first difference at reset: observation[")
    assert finding.evidence["step"] == 0
    assert finding.evidence["seed"] == 1000
    assert finding.evidence["element"] in finding.message
    assert finding.evidence["relative_difference"] > 1e-3


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_shared_world_is_told_beside_a_shared_generator():
    every = findings("broken_repeats.py:SharedWorldThatDraws", "RL401", "RL309", "RL808")
    (finding,) = [finding for finding in every if finding.rule == "RL401"]
    assert "both use PyBullet's client 0 (RL808), and draw from a global random generator (RL309)" in finding.message
    assert "physicsClientId" in finding.fix


@pytest.mark.slow
def test_state_that_reset_keeps_is_named():
    (finding,) = findings("broken_repeats.py:OldActions", "RL301")
    element = finding.evidence["element"]
    keeps = f"reset keeps state (self.position, self.actions); {element} is self.position"
    assert finding.message.endswith(f"; a new process repeats it, so {keeps}{element.removeprefix('observation')}")
    assert finding.fix == "Set back in reset: self.position, self.actions."


@pytest.mark.slow
def test_state_without_effect_is_not_named():
    (finding,) = findings("broken_repeats.py:FirstEpisodeDiffers", "RL302")
    assert finding.message.endswith("; the first episode of an instance differs from all later ones")
    assert "self.kept" not in finding.fix


def test_chance_that_reset_keeps_is_no_missing_seed():
    verdict = verdict_of("broken_repeats.py:KeptChance", "RL308")
    assert verdict.not_judged["RL308"] == "an episode already depends on the previous one (RL301 to RL303)"


def test_a_reward_that_follows_a_nan_of_the_observation_is_no_second_error():
    assert found("broken_envs.py:RL104Diverges", "RL104", "RL601") == {("RL104", "error")}
    assert found("broken_envs.py:RL104Diverges", "RL601") == {("RL601", "error")}


def test_what_a_nearer_rule_explains_is_not_judged():
    verdict = verdict_of("broken_repeats.py:RL302NoisyStep", "RL303", "RL304", "RL305", "RL401", "RL402")
    assert {"RL303", "RL304", "RL305", "RL401", "RL402"} <= verdict.not_judged.keys()
    assert verdict.not_judged["RL305"] == "the same instance already differs from itself (RL301, RL302)"
    assert not {"RL303", "RL304", "RL305", "RL401", "RL402"} & set(verdict.judged)


@pytest.mark.slow
def test_space_that_no_rule_can_look_into_is_said():
    verdict = verdict_of("broken_spaces.py:RL109TextObservation", "RL101", "RL102", "RL103", "RL104")
    assert verdict.findings == []
    assert verdict.not_judged["observation['say']"] == "rules cannot examine a Text space"


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_every_rule_has_a_file_and_environments_that_prove_it(rule):
    words = re.sub(r"[^a-z0-9]+", "_", re.sub(r"[()]", "", rule.name.lower()))
    module = import_module(f"rlctl.checking.rules.{rule.id.lower()}_{words}")
    assert module.RULE is rule
    assert re.fullmatch(r"RL\d{3}", rule.id)
    assert rule.meaning
    assert rule.fix
    proofs = [one for one in list_cases() if rule.id in one.codes]
    assert proofs, f"no environment whose name begins with {rule.id}"
    for proof in proofs:
        assert rule.id in proof.rules
        twin = proof.twin.rpartition(":")[2]
        assert not twin.startswith("RL") or twin.startswith(proof.codes)


def test_a_class_that_is_named_for_a_rule_belongs_to_a_case():
    named = {f"{file.name}:{name}" for file in FOLDER.glob("broken_*.py") for name in find_named_classes(file)}
    in_cases = {name for case in list_cases() for name in (case.broken, case.twin)}
    assert named - in_cases == set()


def find_named_classes(file):
    return re.findall(r"^class (RL\d{3}\w+)", file.read_text(), re.MULTILINE)


def test_every_experiment_has_a_place_of_its_own():
    places = [(one.process, one.place) for one in EXPERIMENTS.values()]
    assert len(places) == len(set(places))
    assert {need for rule in RULES for need in find_needs([rule])} <= EXPERIMENTS.keys()
    assert sum(len(names) for names in PROCESSES.values()) == len(EXPERIMENTS)


def test_every_rule_is_judged():
    assert {rule for rule in RULES if not find_needs([rule])} == set()


def test_a_start_that_no_seed_determines_shows_though_steps_fail():
    assert ("RL301", "error") in found("broken_repeats.py:SamplesTheStart", "RL301")
    verdict = verdict_of("broken_repeats.py:RaisesInStep", "RL301")
    assert (verdict.findings, verdict.not_judged) == ([], {"RL301": "the episode failed (RL201, RL207)"})
