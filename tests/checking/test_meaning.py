"""Numbers that do not mean what they should: each mistake is found in two robots, and nothing in their twins."""

import contextlib
import re
from types import SimpleNamespace

import numpy as np
import pytest

from rlctl.checking.rates import Rate, find_rates
from rlctl.checking.rule import NotApplicable, NotJudged
from rlctl.checking.rules.rl119_mixed_units import _are_mixed_up
from rlctl.checking.transitions import Transitions
from rlctl.checking.values import read_attributes, shape_like
from rlctl.checking.workspaces import find_chains, find_reach, measure_reach
from rlctl.engine import MUJOCO
from rlctl.environments.spec import EnvSpec
from tests.checking.judging import case, check_case, findings, mark_slow, shared_records_of, verdict_of

MEANING, REACH = "broken_meaning.py", "broken_reach.py"


def broken(name, *expected, twin, file=MEANING, **settings):
    return case(f"{file}:{name}", *expected, twin=f"{file}:{twin}", **settings)


CASES = [
    broken("RL616RoverLateReward", ("RL616", "warning"), twin="Rover", slow=True),
    broken("RL616DroneLateReward", ("RL616", "warning"), twin="Drone", slow=True),
    broken("RL617RoverLateSuccess", ("RL617", "warning"), twin="Rover", slow=True),
    broken("RL617DroneLeavesLate", ("RL617", "warning"), twin="RL617DroneLeaves", slow=True),
    broken("RL618RoverLooksRound", ("RL618", "warning"), twin="RL618RoverLooks", slow=True),
    broken("RL618DroneTurnsBack", ("RL618", "warning"), twin="RL618DroneTurns", slow=True),
    broken("RL619RoverBehindTheShore", ("RL619", "warning"), twin="RL619RoverInPond", slow=True),
    broken("RL619ArmFarGoals", ("RL619", "warning"), twin="Arm", file=REACH, slow=True),
    case(
        "broken_reach_bullet.py:RL619ReacherFarGoals",
        ("RL619", "warning"),
        twin="broken_reach_bullet.py:ReacherOfThePlane",
        pybullet=True,
        slow=True,
    ),
    broken("RL121RoverLosesItsGoal", ("RL121", "warning"), twin="RL121RoverSeesBadly"),
    broken("RL121ArmMovesItsGoal", ("RL121", "warning"), twin="Arm", file=REACH, slow=True),
    broken("RL622ArmKeepsAway", ("RL622", "warning"), twin="Arm", file=REACH, slow=True),
    broken("RL622RoverKeepsAway", ("RL605", "warning"), ("RL622", "warning"), twin="Rover", slow=True),
    broken("RL622RoverOfFloat32KeepsAway", ("RL605", "warning"), ("RL622", "warning"), twin="Rover", slow=True),
    broken("RL622PlanarArmKeepsAway", ("RL622", "warning"), twin="PlanarArm", file=REACH, slow=True),
    broken("RL622UprightArmKeepsAway", ("RL622", "warning"), twin="UprightArm", file=REACH, slow=True),
    broken("RL622PosedArmKeepsAway", ("RL622", "warning"), twin="PosedArm", file=REACH, slow=True),
    broken("RL619UprightArmFarGoals", ("RL619", "warning"), twin="UprightArm", file=REACH, slow=True),
    broken("RL623RoverShakes", ("RL623", "warning"), twin="RL623RoverComesNearer"),
    broken("RL623ArmShakes", ("RL623", "warning"), twin="RL623ArmComesNearer", file=REACH, slow=True),
    broken("RL119RoverMillimetres", ("RL118", "info"), ("RL119", "warning"), twin="Rover", slow=True),
    broken("RL119DroneDegrees", ("RL119", "warning"), twin="RL119DroneRadians", slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
def test_goals_that_are_all_out_of_reach_are_an_error():
    others = ("RL603", "warning"), ("RL118", "info"), ("RL611", "info")
    check_case(case(f"{REACH}:ArmGoalsInMillimetres", ("RL619", "error"), *others))


def test_goals_without_a_seed_are_not_judged():
    with pytest.raises(NotJudged, match=r"the seed does not determine what reset draws \(RL301\)"):
        shared_records_of(f"{REACH}:ArmByChance", "goals").require_fact("goals")


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize(
    ("name", "elements"),
    [("PlanarArm", (0, 1)), ("UprightArm", (0, 2)), ("PlanarArmSeesAll", (0, 1, 2)), ("PosedArm", (0, 1))],
)
def test_a_goal_is_what_reset_draws_of_an_attribute(name, elements):
    goals = shared_records_of(f"{REACH}:{name}", "goals").require_fact("goals")
    assert goals.place.name == "self.goal"
    assert goals.place.elements == elements
    assert len(goals.goals[1000]) == len(elements)


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize("name", ["PlanarArm", "UprightArm", "PlanarArmSeesAll", "PosedArm"])
def test_goals_with_a_constant_are_judged_and_sound(name):
    rules = ["RL125", "RL622", "RL623", "RL624", "RL625"]
    verdict = verdict_of(f"{REACH}:{name}", *rules)
    assert verdict.findings == []
    assert verdict.judged == rules


@pytest.mark.slow
def test_the_reach_is_measured_along_the_axes_that_are_drawn():
    goals = shared_records_of(f"{REACH}:UprightArm", "goals").require_fact("goals")
    (reach,) = goals.reaches.values()
    assert reach.distance == pytest.approx(0.55, abs=0.001)  # 0.3 m and 0.25 m
    assert reach.centre == pytest.approx([0.0, 0.1])  # along x and z


@pytest.mark.slow
def test_goals_that_are_reached_at_once_are_none_to_come_nearer_to():
    verdict = verdict_of(f"{REACH}:PlanarArmIsThere", "RL623")
    # More time would change nothing, so that it is not counted among the rules that lack time.
    assert verdict.not_applicable == {"RL623": "episodes are too short, or begin with a success"}


@pytest.mark.slow
def test_what_the_joints_do_not_move_is_not_the_hand():
    goals = shared_records_of(f"{REACH}:ArmUnclearReward", "goals").require_fact("goals")
    (reach,) = goals.reaches.values()  # where the goal itself is observed, its difference to itself is the base
    assert reach.distance == pytest.approx(0.9, abs=0.001)  # 0.2 m up, 0.4 m, 0.3 m


def test_the_reach_of_a_task_in_mujoco_is_measured_by_its_joints():
    with contextlib.closing(EnvSpec("reach", sim=MUJOCO).make()) as env:
        env.reset(seed=0)
        *_, chain = find_chains(env, ())
        reach = measure_reach(chain, chain.names.index("arm/lbr_iiwa_link_7"), range(3))
    # The stretched arm: 0.9 m from the shoulder, which is 0.2 m above the first joint.
    assert reach.distance == pytest.approx(1.1, abs=0.01)
    assert reach.centre == pytest.approx([0, 0, 0.16], abs=0.01)


def test_the_joints_of_an_arm_do_not_move_what_it_pushes(tmp_path):
    # A cube's place may be observed as the hand's is, and the arm gets no nearer to goals of the cube by itself.
    pushing = tmp_path / "pushing.py"
    pushing.write_text(
        "from rlctl_manipulation.reach import Reach\n\n\nclass Push(Reach):\n"
        "    def build(self, sim):\n        super().build(sim)\n"
        "        sim.load('cube', 'cube_4cm.urdf', position=(0.5, 0, 0.02))\n"
    )
    with contextlib.closing(EnvSpec(f"{pushing}:Push", sim=MUJOCO).make()) as env:
        env.reset(seed=0)
        *_, chain = find_chains(env, ())
    assert {name.partition("/")[0] for name in chain.names} == {"arm"}


def test_attributes_of_mixed_shapes_are_read_item_by_item():
    # gym_electric_motor keeps an array of one number next to a number.
    attributes = read_attributes(SimpleNamespace(mixed=[np.zeros(1), 0.5], goal=[0.1, 0.2]))
    assert list(attributes) == ["self.mixed[0]", "self.mixed[1]", "self.goal"]


@pytest.mark.parametrize("value", [np.zeros(1, np.float32), np.float32(0), np.zeros((1, 1)), 0.5])
def test_numbers_take_the_type_of_the_value_that_they_replace(value):
    replaced = shape_like(value, np.array([0.25]))
    assert type(replaced) is type(value)
    assert getattr(replaced, "dtype", None) == getattr(value, "dtype", None)


@pytest.mark.slow
def test_units_are_told_apart_by_the_goal():
    (finding,) = findings(f"{MEANING}:RL119RoverMillimetres", "RL119")
    assert finding.evidence["value"] == 1000.0
    assert "millimetres" in finding.message


def test_looking_moves_the_goal():
    (finding,) = findings(f"{MEANING}:RL121RoverLosesItsGoal", "RL121")
    assert finding.message.startswith("observe() changes self.goal: called twice more after the reset, [")
    assert finding.evidence["value"] != finding.evidence["expected"]


def test_a_sum_over_what_was_seen_is_no_goal():
    assert findings(f"{MEANING}:RoverSumsUp", "RL121") == []


def test_shaking_is_paid_in_proportion_to_the_way():
    (finding,) = findings(f"{MEANING}:RL623RoverShakes", "RL623")
    way = float(re.search(r"moves by ([\d.]+) and back", finding.message)[1])
    # 10 for each metre towards the goal, which is not quite in the direction of the way.
    assert 0 < finding.evidence["value"] <= 10 * way


@pytest.mark.parametrize(("rows", "columns", "last"), [(9, 0, False), (9, 3, True)], ids=["constant", "one step"])
def test_where_nothing_changes_nothing_has_a_rate(rows, columns, last):
    table, flags, numbers = np.zeros((rows, columns)), np.full(rows, last), np.zeros(rows)
    counts = np.arange(rows)
    steps = Transitions(
        table, table, numbers[:, None], numbers[:, None], numbers, flags, flags, flags, counts, counts, ["x"] * columns
    )
    assert list(find_rates(steps)) == []


@pytest.mark.slow
def test_jump_of_an_angle_is_measured():
    (finding,) = findings(f"{MEANING}:RL618RoverLooksRound", "RL618")
    # 0.3 times a change of the difference by 2 pi, at most.
    assert 0.1 < finding.evidence["value"] < 0.3 * 2 * np.pi


def test_edge_of_a_workspace_is_found_and_a_path_has_none():
    rng = np.random.default_rng(0)
    angles, radii = rng.uniform(-np.pi, np.pi, 2000), np.sqrt(rng.uniform(0, 4.0, 2000))
    disk = np.array([1.0 + radii * np.cos(angles), radii * np.sin(angles) - 1.0]).T
    episodes = np.repeat(np.arange(20), 100)
    reach = find_reach(disk, episodes)
    assert reach.centre == pytest.approx([1.0, -1.0], abs=0.05)
    assert reach.distance == pytest.approx(2.0, abs=0.05)
    walk = np.cumsum(rng.normal(size=(20, 100, 2)), axis=1).reshape(-1, 2)
    with pytest.raises(NotApplicable):
        find_reach(walk, episodes)


def test_a_speed_that_is_a_part_of_the_other_place_fits_by_chance():
    joint = Rate("observation[16]", "observation[35]", 0.1, 3.0)
    length = Rate("length of (observation[34] to observation[35])", "|observation[17]|", 0.001, 9.0)
    assert _are_mixed_up(joint, length)
    assert not _are_mixed_up(joint, Rate("observation[35]", "observation[3]", 0.001, 9.0))  # place, speed, acceleration
