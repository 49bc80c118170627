"""RL815: parts of the state that a step reads before it moves the robot."""

import pytest

from tests.checking.judging import case, check_case, findings, found_in_source, mark_slow

pytest.importorskip("mujoco")

FILE = "broken_late.py"
PAIRS = {
    "RL815CrabLooksFirst": "Crab",
    "SnailSeesFirst": "Snail",
    "LobsterReadsFirst": "Lobster",
    "LobsterReadsFirstInOneStep": "LobsterInOneStep",
}
CASES = [case(f"{FILE}:RL815CrabLooksFirst", ("RL815", "warning"), twin=f"{FILE}:Crab", pybullet=True, slow=True)]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("name", PAIRS)
def test_finds_what_is_read_too_early(name):
    assert found_in_source(f"{FILE}:{name}").keys() == {"RL815"}
    assert not found_in_source(f"{FILE}:{PAIRS[name]}")


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("name", ["CrabSteersByIt", "CrabKeepsAView", "CrabKeepsTime", "SnailRemembers", "SnailGains"])
def test_what_is_read_again_or_meant_to_be_older(name):
    assert not found_in_source(f"{FILE}:{name}")


@pytest.mark.slow
@pytest.mark.pybullet
def test_names_both_lines():
    (finding,) = findings(f"{FILE}:RL815CrabLooksFirst", "RL815")
    assert "for which to_body @ self.data.qvel[:2] is read before the robot moves" in finding.message
