"""The reward: its size, its terms, what it makes worth doing, and success; and the search that they need."""

import dataclasses

import numpy as np
import pytest
from gymnasium import spaces

from rlctl.checking.episode import action_at
from rlctl.checking.rewards import discounted_steps, discounted_sum
from rlctl.checking.rules.rl605_hovering_pays_more_than_finishing import compare_returns
from rlctl.checking.term_names import is_about_actions
from tests.checking.judging import case, check_case, findings, found, mark_slow, rules_of, shared_records_of

BROKEN = "broken_rewards.py"


def broken(name, *expected, twin=None, **settings):
    return case(f"{BROKEN}:{name}", *expected, twin=f"{BROKEN}:{twin}" if twin else "broken_envs.py:Clean", **settings)


CASES = [
    broken("RL602ConstantReward", ("RL602", "warning"), slow=True),
    broken("RL602SparseNeverFound", ("RL602", "info"), ("RL611", "info"), slow=True),
    broken("RL603LargeReward", ("RL603", "warning"), twin="RL603FinalBonus", slow=True),
    broken("RL603LargeTerm", ("RL603", "warning"), twin="RL603FinalBonus", slow=True),
    broken("RL603HugeOnce", ("RL603", "warning"), twin="RL603FinalBonus", slow=True),
    broken("RL604Falls", ("RL604", "warning"), twin="RL604FallsBadly", slow=True),
    broken("RL604FallsUntold", ("RL604", "warning"), ("RL609", "info"), twin="RL604FallsBadly", slow=True),
    broken("RL605Hovering", ("RL605", "warning"), twin="RL605FinishingPays", slow=True),
    broken("RL605HoveringUntold", ("RL605", "warning"), ("RL609", "info"), twin="RL605PaysProgress", slow=True),
    *(
        case(
            f"broken_incomes.py:RL605{robot}EndsIncome",
            ("RL605", "warning"),
            twin=f"broken_incomes.py:{robot}PaysAll",
            pybullet=True,
            slow=True,
        )
        for robot in ("Rover", "Arm", "Reacher")
    ),
    broken("RL606AliveBonus", ("RL606", "warning"), twin="RL606Paid", slow=True),
    broken("RL606AliveUntold", ("RL606", "info"), twin="RL606Paid", slow=True),
    broken("RL609SuccessUntold", ("RL609", "info"), twin="RL609SuccessArray", slow=True),
    broken("RL609SuccessMisnamed", ("RL609", "info"), twin="RL609SuccessOtherwiseNamed", slow=True),
    broken("RL609SuccessIsAShare", ("RL609", "info"), slow=True),
    broken("RL610SuccessAtStart", ("RL610", "warning"), twin="RL610SuccessOnAverage"),
    broken("RL611SuccessNever", ("RL611", "info"), slow=True),
    broken("RL612WrongSlice", ("RL612", "warning"), twin="RL612TimePenalty", slow=True),
    broken("RL620ActionWithItself", ("RL620", "warning"), twin="RL620Smooth", slow=True),
    broken("RL620WeightInAnAttribute", ("RL620", "warning"), twin="RL620Smooth", slow=True),
    broken("RL620WeightInAMethod", ("RL620", "warning"), twin="RL620Smooth", slow=True),
    broken("RL620WeightOfZero", ("RL620", "info"), twin="RL620Smooth", slow=True),
    broken("RL621EffortPays", ("RL621", "warning"), twin="Terms", slow=True),
    broken("RL621CalledPenalty", ("RL621", "info"), twin="RL621LowersTheReward", slow=True),
    case(
        "broken_models.py:RL620CartComparesWithItself",
        ("RL620", "warning"),
        twin="broken_models.py:RL620CartSmooth",
        slow=True,
    ),
    case("broken_models.py:RL621CartSignTwice", ("RL621", "warning"), twin="broken_models.py:CartTask", slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


CLEAN = [
    f"{BROKEN}:{name}"
    for name in (
        *("RL603FinalBonus", "RL604FallsBadly", "RL605FinishingPays", "RL605PaysProgress", "Terms", "SparseTerm"),
        *("RL612TimePenalty", "RL606Paid", "RL609SuccessArray"),
    )
]


@pytest.mark.slow
@pytest.mark.parametrize("task", CLEAN)
def test_clean_is_clean(task):
    assert found(task, *rules_of("RL6")) == set()


@pytest.mark.slow
def test_goal_that_ends_the_episode_is_no_failure():
    assert found(f"{BROKEN}:EndsAtUntoldGoal", *rules_of("RL6")) == {("RL609", "info")}


def finding_of(name):
    (case,) = [each for each in CASES if each.broken == f"{BROKEN}:{name}"]
    (finding,) = findings(case.broken, *case.rules)
    return finding


@pytest.mark.slow
@pytest.mark.parametrize(("name", "key"), [("RL609SuccessMisnamed", "goal_reached"), ("Succeeds", "succeed")])
def test_what_is_probably_meant_as_success_is_named(name, key):
    (finding,) = findings(f"{BROKEN}:{name}", "RL609")
    assert f"'{key}' in info is not used" in finding.message


def test_worth_is_discounted():
    # 1 + 0.99 * 2 + 0.9801 * 3 = 5.9203; -(1 + 0.99 + 0.9801) = -2.9701
    assert discounted_sum(np.array([1.0, 2.0, 3.0])) == pytest.approx(5.9203)
    assert discounted_steps(-1.0, 3) == pytest.approx(-2.9701)


@pytest.mark.slow
def test_falling_is_compared_with_going_on():
    evidence = finding_of("RL604Falls").evidence
    mean, last, steps = evidence["mean_reward"], evidence["value"], evidence["step"]
    # The fall is beyond 1.5 m in one direction, so at least that far from the middle.
    assert -2.2 < last <= -1.5
    # It costs more than a usual step, and saves the 50 - steps that are left.
    saved = last - mean - 0.99 * mean * (1 - 0.99 ** (50 - steps)) / 0.01
    assert 0 < evidence["gain"] <= saved


@pytest.mark.slow
def test_stopping_is_compared_from_where_it_begins():
    episode = shared_records_of("broken_envs.py:Clean", "search").role("search")[0]
    finished = dataclasses.replace(episode, rewards=np.array([0.0, 0.0, 9.0]))
    stopped = dataclasses.replace(episode, rewards=np.array([0.0, 0.0, 5.0, 5.0]), ended="steps")
    stop = compare_returns(finished, stopped, at=2, longest=6)
    # From the third step on: 9, against 5 for each of the steps 3 to 6, the last two of them not played.
    assert (stop.step, stop.per_step) == (3, 5.0)
    assert (stop.finishing, stop.stopping) == pytest.approx((9.0, 5 * (1 + 0.99 + 0.9801 + 0.970299)))
    ended = dataclasses.replace(stopped, ended="truncated")
    assert compare_returns(finished, ended, at=2, longest=6).stopping == pytest.approx(5 * 1.99)


@pytest.mark.slow
def test_hovering_is_found_and_placed():
    finding = finding_of("RL605Hovering")
    # Between 9.6 (0.4 from the goal) and 9.9 (0.1 from it) per step.
    assert 9.6 < finding.evidence["per_step"] < 9.9
    assert finding.message.startswith("finishing at step ")
    assert f" from step {finding.evidence['step']} on; " in finding.message


@pytest.mark.slow
def test_doing_nothing_earns_the_bonus():
    evidence = finding_of("RL606AliveBonus").evidence
    # 50 steps of 1: (1 - 0.99^50) / 0.01 = 39.4994
    assert evidence["value"] == pytest.approx(39.4994, abs=1e-4)
    assert (evidence["term"], evidence["share"]) == ("alive", 1.0)


@pytest.mark.slow
def test_constant_penalty_is_named():
    evidence = finding_of("RL612WrongSlice").evidence
    # -0.05 * 5
    assert (evidence["term"], evidence["value"]) == ("effort", -0.25)


def test_numbers_become_actions_of_every_kind():
    space = spaces.Dict(
        {
            "arm": spaces.Box(np.array([-1.0, 0.0], np.float32), np.array([1.0, np.inf], np.float32)),
            "gear": spaces.Discrete(3, start=1),
            "more": spaces.Tuple([spaces.MultiDiscrete([2, 4]), spaces.MultiBinary(2)]),
        }
    )
    for numbers, arm, gear, more in [
        (np.zeros(7), [-1.0, 0.0], 1, ([0, 0], [0, 0])),
        (np.full(7, 0.5), [0.0, 0.5], 2, ([1, 2], [1, 1])),
        (np.ones(7), [1.0, 1.0], 3, ([1, 3], [1, 1])),
    ]:
        action = action_at(space, numbers)
        assert space.contains(action)
        assert action["arm"].tolist() == arm
        assert action["gear"] == gear
        assert tuple(part.tolist() for part in action["more"]) == more


@pytest.mark.slow
def test_the_term_that_makes_a_reward_large_is_named():
    (finding,) = findings(f"{BROKEN}:RL603LargeTerm", "RL603")
    assert finding.evidence["term"] == "distance"
    assert finding.message.endswith("; most of it is the term 'distance'")


@pytest.mark.parametrize(
    ("name", "judged"),
    [
        *[("action_rate", True), ("actionRate", True), ("ctrl_cost", True), ("joint_torques_l2", True)],
        *[("excess_torque", False), ("torque_limit", False), ("gripper_action", False), ("distance", False)],
    ],
)
def test_costs_of_actions_are_known_by_their_names(name, judged):
    assert is_about_actions(name) == judged


@pytest.mark.slow
def test_search_finds_what_chance_does_not():
    lives = shared_records_of("reach", "search").role("search")
    assert any(life.infos["is_success"].values.any() for life in lives if life.actions == "searched")
    assert len({life.seed for life in lives if life.actions == "searched"}) == 1
    assert sum(life.steps for life in lives) <= 6200
