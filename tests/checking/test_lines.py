"""RL124, RL125, RL129, RL701, RL834, RL835, RL840, RL843: vectors turned, elements read, ids compared, by lines."""

from types import SimpleNamespace

import pytest

from rlctl.checking.check import judge
from rlctl.checking.experiments.expressions import BY_EXPRESSIONS
from rlctl.checking.records import Records
from rlctl.checking.rule import RuleFinding
from rlctl.checking.rule_index import RULES
from rlctl.checking.rules.rl840_two_motors_of_one_joint import _find_doubled_joints
from tests.checking.judging import case, check_case, findings, found_in_source, mark_slow

TURNED = {
    "KiteDown": "RL124",
    "RL124KiteNorth": "RL124",
    "KiteWay": "RL125",
    "RL124KiteLens": "RL124",
    "BargeWay": "RL125",
    "RL701BargeCopied": "RL701",
    "RL129SkiffWayInTheWorld": "RL129",
}
CASES = [
    case(f"broken_lines.py:{name}", (name[:5], "warning"), twin=f"broken_lines.py:{twin}", slow=True)
    for name, rule in TURNED.items()
    for twin in ("Kite", "Barge", "Skiff")
    if rule in name and twin in name  # the others show as RL129 in the whole check
]
DINGHIES = {
    "RL129DinghyVelocity": "Dinghy",
    "RL129DinghyClipped": "Dinghy",
    "RL129DinghyScaled": "DinghyScaled",
    "RL129DinghyZipped": "DinghyZipped",
}
COMPARED = ["RL834BipedAsksForBodies", "RL834BipedAsksForJoints", "RL835BipedLeftTwice", "RL835BipedTwoOfTheRight"]
CASES += [
    case(f"broken_dinghies.py:{name}", ("RL129", "warning"), twin=f"broken_dinghies.py:{twin}", slow=True)
    for name, twin in DINGHIES.items()
]
CASES += [
    case(f"broken_ids.py:{name}", (name[:5], "warning"), twin="broken_ids.py:Biped", slow=True) for name in COMPARED
]
CASES += [case("broken_ids.py:RL840BipedDrivesLeftTwice", ("RL840", "warning"), twin="broken_ids.py:Biped")]
CASES += [case("broken_frames.py:RL843HopperSinks", ("RL843", "warning"), twin="broken_frames.py:HopperWatchesItself")]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    if case.broken.startswith(("broken_ids", "broken_frames")):
        pytest.importorskip("mujoco")
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize("name", TURNED)
def test_a_line_turns_a_vector_the_wrong_way_or_leaves_out_an_element_of_the_action(name):
    assert found_in_source(f"broken_lines.py:{name}").keys() == {TURNED[name]}


@pytest.mark.slow
@pytest.mark.parametrize("name", DINGHIES)
def test_a_vector_of_the_world_is_observed_with_noise(name):
    assert found_in_source(f"broken_dinghies.py:{name}").keys() == {"RL129"}
    assert found_in_source(f"broken_dinghies.py:{DINGHIES[name]}") == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", COMPARED)
def test_a_line_compares_or_looks_up_the_wrong_ids(name):
    pytest.importorskip("mujoco")
    assert found_in_source(f"broken_ids.py:{name}").keys() == {name[:5]}


@pytest.mark.slow
@pytest.mark.parametrize("task", ["broken_lines.py:Kite", "broken_lines.py:Barge", "broken_lines.py:Skiff"])
def test_their_twins_are_right(task):
    assert found_in_source(task) == {}


@pytest.mark.slow
def test_the_twin_that_compares_geoms_is_right():
    pytest.importorskip("mujoco")
    assert found_in_source("broken_ids.py:Biped") == {}


@pytest.mark.slow
def test_a_finding_names_the_line():
    (finding,) = findings("broken_lines.py:RL124KiteLens", "RL124")
    assert "matrix.T @ LENS" in finding.message
    assert finding.where is not None
    assert finding.where[0].endswith("broken_lines.py")


def test_a_line_is_not_reported_where_an_experiment_has_shown_the_same():
    records = Records("any", normalizes=lambda what: False)
    records.facts[BY_EXPRESSIONS] = [RuleFinding(RULES["RL129"], "a line", same=["RL124"])]
    assert [finding.message for finding in judge(records, ["RL129"]).findings] == ["a line"]
    records.findings.append(RuleFinding(RULES["RL124"], "elements of the observation"))
    assert judge(records, ["RL129"]).findings == []


PUSHED = """<mujoco><worldbody><body><joint name="slide" type="slide" axis="1 0 0"/><geom size=".1"/>
<body><joint name="pole"/><geom type="capsule" fromto="0 0 0 0 0 .5" size=".02"/></body></body></worldbody><actuator>
<motor name="left" joint="slide" gear="10" ctrlrange="LEFT"/>
<motor name="right" joint="slide" gear="-10" ctrlrange="0 1"/></actuator></mujoco>"""


@pytest.mark.parametrize(("left", "expected"), [("0 1", []), ("-1 1", ["RL840"])])
def test_motors_that_push_against_each_other_are_meant(left, expected):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(PUSHED.replace("LEFT", left))
    env = SimpleNamespace(model=model, data=mujoco.MjData(model))
    assert [finding.rule for finding in _find_doubled_joints(SimpleNamespace(env=env))] == expected
