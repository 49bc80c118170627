"""RL129, RL636; further forms of RL115, RL119, RL815, RL820 and RL832: in sums, in lengths, or by the source only."""

import pytest

from tests.checking.judging import case, check_case, found, mark_slow

pytest.importorskip("mujoco")


def broken(name, twin, **settings):
    return case(f"broken_directions.py:{name}", (name[:5], "warning"), twin=f"broken_directions.py:{twin}", **settings)


CASES = [
    broken("RL129TugInTheWorld", "Tug"),
    broken("RL129GlintInTheWorld", "Glint", slow=True),
    broken("RL129TugTurnedTwice", "Tug", slow=True),
    broken("RL129TugEast", "TugAhead", slow=True),
    broken("RL129PlatformInTheWorld", "Platform", slow=True),
    broken("RL115TugOldView", "Tug", slow=True),
    broken("RL119TugTiltsInDegrees", "TugThatTilts", slow=True),
    broken("RL636TugPaidLate", "Tug", slow=True),
    broken("RL636GlintPaidLate", "Glint", slow=True),
    broken("RL832TugFast", "Tug", slow=True),
    broken("RL832GlintFast", "Glint", slow=True),
    broken("RL815TugOldWay", "Tug", slow=True),
    broken("RL815BallGantryOldWays", "BallGantry", pybullet=True, slow=True),
    broken("RL820BallGantryFast", "BallGantry", pybullet=True, slow=True),
    case("broken_winds.py:RL129KayakCurrent", ("RL129", "warning"), twin="broken_winds.py:Kayak", slow=True),
    case("broken_winds.py:RL129BlimpWind", ("RL129", "warning"), twin="broken_winds.py:Blimp", slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
def test_a_robot_that_observes_its_heading_may_look_along_the_axes_of_the_world():
    assert found("broken_directions.py:TugWithACompass", "RL129") == set()


@pytest.mark.slow
def test_episodes_that_end_at_other_steps_in_a_turned_world_are_compared_up_to_there():
    assert found("broken_directions.py:TugEndsInTheEast", "RL129") == {("RL129", "warning")}
