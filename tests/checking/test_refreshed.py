"""RL131, RL620: the value of the step before, replaced before the difference to it is taken."""

import pytest

from tests.checking.judging import case, check_case, findings, found_in_source, mark_slow

pytest.importorskip("mujoco")

FILE = "broken_refreshed.py"
PAIRS = {
    "SledRefreshesFirst": ("RL131", "Sled"),
    "SledAliases": ("RL131", "SledInPlace"),
    "SledReadsTheNewest": ("RL131", "SledOfHistory"),
    "SledKeepsItAfterwards": ("RL131", "SledInOneMethod"),
    "SledOfNoRates": ("RL131", "SledOfRates"),
    "SledGainsNothing": ("RL620", "SledOfGains"),
    "RL131FloatFiltersNothing": ("RL131", "Float"),
    "FloatKeepsAView": ("RL620", "FloatShowsTwice"),
}
CASES = [case(f"{FILE}:RL131FloatFiltersNothing", ("RL131", "warning"), twin=f"{FILE}:Float", slow=True)]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
def test_finds_a_difference_to_what_has_been_replaced(name):
    rule, twin = PAIRS[name]
    assert found_in_source(f"{FILE}:{name}").keys() == {rule}
    assert not found_in_source(f"{FILE}:{twin}")


@pytest.mark.slow
def test_names_what_is_kept():
    (finding,) = findings(f"{FILE}:RL131FloatFiltersNothing", "RL131")
    assert finding.message.startswith("self.smooth = self.filtered() is computed where self.data.qpos - self.last_q is")
