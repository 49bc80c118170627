"""RL642: values that a reset keeps before it has placed the robot."""

import pytest

from tests.checking.judging import case, check_case, findings, found_in_source, mark_slow

pytest.importorskip("mujoco")

FILE = "broken_early.py"
PAIRS = {
    "RaftKeepsFirst": "Raft",
    "RaftHeadingOfTheModel": "RaftNominal",
    "RL642PuckDistanceBeforeTheSpot": "Puck",
    "LanderBeginsFirst": "Lander",
    "LanderUnpacksFirst": "Lander",
}
CASES = [
    case(f"{FILE}:RL642PuckDistanceBeforeTheSpot", ("RL642", "warning"), twin=f"{FILE}:Puck", pybullet=True, slow=True)
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("name", PAIRS)
def test_finds_what_is_read_too_early(name):
    assert "RL642" in found_in_source(f"{FILE}:{name}")
    assert not found_in_source(f"{FILE}:{PAIRS[name]}")


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("name", ["RaftSettles", "RaftLevels", "PuckGlides"])
def test_what_happens_in_between_and_what_is_read_of_the_last_episode(name):
    assert "RL642" not in found_in_source(f"{FILE}:{name}")


@pytest.mark.slow
@pytest.mark.pybullet
def test_names_both_values():
    (finding,) = findings(f"{FILE}:RaftHeadingOfTheModel", "RL642")
    assert finding.message.startswith("self.heading = start_yaw reads 0, and at the end of the same reset start_yaw is")
