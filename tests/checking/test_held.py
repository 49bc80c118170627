"""Robots that fall before their time is up, which are held to see what an environment does as time goes by."""

import pytest

from tests.checking.judging import case, check_case, findings, mark_slow, shared_records_of, verdict_of

HELD = "broken_held.py"


def broken(name, *expected, twin, **settings):
    return case(f"{HELD}:{name}", *expected, twin=f"{HELD}:{twin}", **settings)


CASES = [
    broken("RL122CrawlerSeesLate", ("RL122", "warning"), twin="FallingCrawler", pybullet=True, slow=True),
    broken("RL122HopperSeesLate", ("RL122", "warning"), twin="FallingHopper", slow=True),
    broken("RL501HopperTimeIsUp", ("RL501", "warning"), twin="RL501HopperStandsStill", slow=True),
    broken("RL501CrawlerTimeIsUp", ("RL501", "warning"), twin="FallingCrawler", pybullet=True, slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.pybullet
def test_time_passes_while_a_robot_is_held():
    held = shared_records_of(f"{HELD}:FallingCrawler", "episodes", "held").facts["held"]
    assert [(episode.ended, len(episode.rewards)) for episode in held] == [("truncated", 150)] * 3


@pytest.mark.slow
@pytest.mark.pybullet
def test_the_first_late_command_is_placed():
    (finding,) = findings(f"{HELD}:RL122CrawlerSeesLate", "RL122")
    # The speed changes after steps 20, 40, ... 140 of each of three episodes.
    assert finding.evidence["step"] == 20
    assert finding.message.endswith("so it is 21 of 21 times")


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_robot_is_held_without_another_experiment():
    records = shared_records_of(f"{HELD}:FallingCrawler", "held")
    assert len(records.facts["held"]) == 3
    assert records.trajectories == []


@pytest.mark.slow
@pytest.mark.pybullet
def test_what_lives_by_itself_is_not_held():
    verdict = verdict_of("robots.py:Crawler", "RL122")
    assert verdict.not_applicable["RL122"] == "it lives long enough by itself"
