"""Landings, contacts and motors of a leg in MuJoCo."""

import re

import pytest

from tests.checking.judging import case, check_case, findings, mark_slow

pytest.importorskip("mujoco")
FILE = "broken_legs.py"
CONSTANT = ("RL110", "info")


def broken(name, *more, severity="warning", twin="Leg"):
    return case(f"{FILE}:{name}", (name[:5], severity), *more, twin=f"{FILE}:{twin}", slow=True)


CASES = [
    broken("RL628LegLandsInEveryStep"),
    broken("RL811LegOrder", severity="error"),
    broken("RL834LegFeelsNothing", CONSTANT),
    broken("RL834LegSearchesTheShin", CONSTANT, twin="RL834LegSearches"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
def test_the_message_about_a_sensor_says_how_far_the_contacts_are():
    (finding,) = findings(f"{FILE}:RL834LegFeelsNothing", "RL834")
    distance = float(re.search(r"the nearest contact is ([0-9.]+) m", finding.message)[1])
    # The foot is a ball of 0.02 m, and the site 0.06 m from its centre: no contact is nearer than 0.04 m, and one below
    # the foot while it stands upright is sqrt(0.06^2 + 0.02^2) = 0.063 m away.
    assert 0.04 < distance < 0.07
