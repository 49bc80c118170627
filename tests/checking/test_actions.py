"""Actions that do nothing."""

import numpy as np
import pytest
from gymnasium import spaces

from rlctl.checking.action_trials import find_dimensions
from rlctl.checking.episode import draw_actions
from rlctl.environments.leaves import find_leaves
from tests.checking.judging import case, check_case, findings, found, mark_slow, rules_of, verdict_of

FILE = "broken_actions.py"
CASES = [
    case(f"{FILE}:RL701DeadAction", ("RL701", "warning"), twin=f"{FILE}:RL701LateAction"),
    case(f"{FILE}:RL701NoAction", ("RL701", "error")),
    case(f"{FILE}:RL701DeadChoice", ("RL701", "error"), twin=f"{FILE}:RL701Choice"),
    case(f"{FILE}:RL701CostlyAction", ("RL701", "warning"), twin=f"{FILE}:RL701HiddenAction"),
    case(f"{FILE}:RL701CopiedAction", ("RL701", "info")),
    case(f"{FILE}:RL701OnlyCosts", ("RL701", "error"), twin=f"{FILE}:RL701Switch"),
    case(f"{FILE}:RL701OnlyCopies", ("RL701", "error"), twin=f"{FILE}:RL701Switch"),
    case(f"{FILE}:RL705ChangesAction", ("RL705", "warning"), slow=True),
    case(f"{FILE}:RL705ChangesPartOfAction", ("RL705", "warning"), slow=True),
    case("broken_robots.py:RL701ArmPullsOnly", ("RL701", "warning"), twin="robots.py:Arm"),
    case("broken_robots.py:RL701BoatForwardOnly", ("RL701", "warning"), twin="robots.py:Boat"),
]
CASES += [
    case(f"broken_maps.py:RL707{robot}FallsBack", ("RL707", "warning"), twin=twin, pybullet=True, slow=robot != "Rover")
    for robot in ("Rover", "Drone", "Arm", "Crawler")
    for twin in (f"broken_maps.py:RL707{robot}Switches",)
]
CLEAN = [f"{FILE}:RL701Switch", f"{FILE}:Valves"]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


def test_actions_are_not_judged_where_step_returns_nothing_to_read():
    verdict = verdict_of("broken_actions.py:ReturnsNothing", "RL701")
    assert verdict.findings == []
    assert "(RL201)" in verdict.not_judged["RL701"]


@pytest.mark.slow
@pytest.mark.parametrize("task", CLEAN)
def test_clean_is_clean(task):
    assert found(task, *rules_of("RL7")) == set()


def the_finding(name, rule):
    (finding,) = findings(f"{FILE}:{name}", rule)
    return finding


def test_global_draws_hide_no_dead_action():
    task = f"{FILE}:DeadActionOfGlobalDraws"
    assert found(task, "RL301", "RL309", "RL701") == {("RL301", "error"), ("RL309", "warning"), ("RL701", "warning")}


def test_what_differs_before_an_action_is_no_answer_to_it():
    assert found(f"{FILE}:WaitsAndKeepsATrace", "RL636") == set()


def test_dead_actions_are_named():
    finding = the_finding("RL701DeadAction", "RL701")
    assert finding.message == (
        "action[1] changes nothing: at its lowest and highest value, over 60 steps from two seeds"
    )
    assert finding.evidence == {
        "value": ["action[1]"],
        "seed": 1000,
        "seeds": [1000, 1001],
        "steps": 60,
    }
    assert the_finding("RL701NoAction", "RL701").message.startswith("no element of the action changes anything: at its")


def test_a_first_episode_unlike_the_others_hides_nothing():
    assert the_finding("DeadLater", "RL701").evidence["value"] == ["action[1]"]


@pytest.mark.slow
def test_rewards_that_actions_change_in_a_series_are_worth_knowing():
    finding = the_finding("Watched", "RL701")
    assert finding.message.startswith("no element of the action changes anything but its own step's reward")
    assert finding.severity == "info"


@pytest.mark.slow
def test_a_choice_has_no_zero_that_costs_nothing():
    assert found(f"{FILE}:Trader", "RL701") == {("RL701", "info")}


def test_what_is_not_repeatable_is_not_judged():
    verdict = verdict_of("broken_repeats.py:NoisyByItsOwnGenerator", "RL701")
    assert verdict.not_judged["RL701"] == "equal seeds and actions give unequal episodes (RL3)"


def test_ends_of_whole_numbers_are_whole_numbers():
    """As floats, those of 64 bits would not fit into the action."""
    for dtype in (np.int64, np.uint64):
        bounds = np.iinfo(dtype)
        (dimension,) = find_dimensions(find_leaves(spaces.Box(bounds.min, bounds.max, (1,), dtype)))
        assert dimension.ends == (bounds.min, bounds.max)
    (unbounded,) = find_dimensions(find_leaves(spaces.Box(-np.inf, 5.0, (), np.float32)))
    assert unbounded.ends == (-1.0, 5.0)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(np.array([-2.0, 0.5], np.float32), np.array([3.0, 7.0], np.float32)),
        spaces.Box(-1.0, 1.0, (2, 3), np.float64),
        spaces.Box(-1.0, 1.0, ()),
        spaces.Box(-np.inf, np.inf, (2,)),
        spaces.Box(0, 255, (3,), np.uint8),
        spaces.Dict({"grip": spaces.Discrete(3), "move": spaces.Box(-1.0, 1.0, (2,))}),
    ],
    ids=str,
)
def test_random_actions_are_the_samples_of_the_space(space):
    drawn = draw_actions(space, "random", 5)
    space.seed(5)
    for _ in range(200):
        np.testing.assert_equal(next(drawn), space.sample(), strict=isinstance(space, spaces.Box))


def test_a_gripper_that_has_nothing_to_grasp_is_an_info():
    assert found("broken_actions.py:GrasperFarAway", "RL701") == {("RL701", "info")}


@pytest.mark.slow
@pytest.mark.pybullet
def test_dead_halves_at_both_ends_are_a_warning():
    assert found("broken_robots.py:ArmPullsWithOneMotor", "RL701") == {("RL701", "info")}
    assert found("broken_robots.py:ArmPullsAndPushes", "RL701") == {("RL701", "warning")}
