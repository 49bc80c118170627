"""RL622: goals that go away and pay, success that costs; RL125: goals turned the wrong way. On robots that turn."""

import pytest

from tests.checking.judging import case, check_case, findings, mark_slow

pytest.importorskip("mujoco")


def broken(name, twin, **settings):
    file = "broken_progress.py"
    return case(f"{file}:{name}", (name[:5], "warning"), twin=f"{file}:{twin}", **settings)


CASES = [
    broken("RL622BoatGoesAway", "BoatSeeks", pybullet=True),
    broken("RL622FlyerGoesAway", "FlyerSeeks"),
    broken("RL622CartGoesAway", "CartSeeks"),
    broken("RL622PuckGoesAway", "PuckSeeks", pybullet=True),
    broken("RL622ArmCostsSuccess", "ArmPaysSuccess"),
    broken("RL622FlyerCostsSuccess", "FlyerPaysSuccess"),
    broken("RL622CartCostsSuccess", "CartPaysSuccess"),
    broken("RL622PuckCostsSuccess", "PuckPaysSuccess", pybullet=True),
    broken("RL125CartTurnsBack", "CartSeeks", slow=True),
    broken("RL125FlyerTurnsBack", "FlyerSeeks"),
    broken("RL125HopperTurnsBack", "HopperSeeks"),
    broken("RL125PuckTurnsBack", "PuckSeeks", pybullet=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("RL622BoatGoesAway", ("comes", "nearer in a step", "where it goes as far away")),
        ("RL622ArmCostsSuccess", ("the reward is larger at any distance to the goal",)),
    ],
)
def test_finding_says_what_pays(name, words):
    (finding,) = findings(f"broken_progress.py:{name}", "RL622")
    assert [word for word in words if word not in finding.message] == []
