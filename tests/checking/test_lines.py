"""RL124, RL125, RL129, RL701, RL834 and RL835 by lines: vectors that are turned, elements read, and ids compared."""

import pytest

from tests.checking.judging import findings, found

TURNED = ["RL124KiteDown", "RL124KiteNorth", "RL125KiteWay", "RL124KiteLens", "RL125BargeWay", "RL701BargeCopied"]
TURNED += ["RL129SkiffWayInTheWorld"]
COMPARED = ["RL834BipedAsksForBodies", "RL834BipedAsksForJoints", "RL835BipedLeftTwice", "RL835BipedTwoOfTheRight"]
RULES = ["RL124", "RL125", "RL129", "RL701", "RL834", "RL835"]


@pytest.mark.slow
@pytest.mark.parametrize("name", TURNED)
def test_a_line_turns_a_vector_the_wrong_way_or_leaves_out_an_element_of_the_action(name):
    assert found(f"broken_lines.py:{name}", *RULES) == {(name[:5], "warning")}


@pytest.mark.slow
@pytest.mark.parametrize("name", COMPARED)
def test_a_line_compares_or_looks_up_the_wrong_ids(name):
    pytest.importorskip("mujoco")
    assert found(f"broken_ids.py:{name}", *RULES) == {(name[:5], "warning")}


@pytest.mark.slow
@pytest.mark.parametrize(
    "task", ["broken_lines.py:Kite", "broken_lines.py:Barge", "broken_lines.py:Skiff", "broken_ids.py:Biped"]
)
def test_their_twins_are_right(task):
    pytest.importorskip("mujoco")
    assert found(task, *RULES) == set()


@pytest.mark.slow
def test_a_finding_names_the_line():
    (finding,) = findings("broken_lines.py:RL124KiteLens", "RL124")
    assert "matrix.T @ LENS" in finding.message
    assert finding.where is not None
    assert finding.where[0].endswith("broken_lines.py")
