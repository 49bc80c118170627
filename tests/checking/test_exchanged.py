"""RL645."""

import pytest

from tests.checking.judging import case, check_case, found_in_source, mark_slow

FILE = "broken_exchanged.py"
PAIRS = {"RL645BoatKeepsNoSpeeds": "BoatKeepsSpeeds", "RL645BoatIsPushedBySomethingElse": "BoatIsPushed"}
CASES = [case(f"{FILE}:{name}", ("RL645", "warning"), twin=f"{FILE}:{twin}", slow=True) for name, twin in PAIRS.items()]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
def test_reads_the_calls(name):
    assert [*found_in_source(f"{FILE}:{name}")] == ["RL645"]
    assert not found_in_source(f"{FILE}:{PAIRS[name]}")


@pytest.mark.slow
def test_what_is_exchanged_on_purpose_is_no_mistake():
    assert not found_in_source(f"{FILE}:BoatLooksBack")
