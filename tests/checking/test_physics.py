"""RL8: each rule finds its mistake in a PyBullet world, with the right numbers."""

import inspect

import numpy as np
import pytest

from rlctl.checking.rules.rl804_joint_beyond_its_limits import measure_outside
from rlctl.checking.worlds import Joint
from rlctl.environments.bullet_calls import record_calls
from rlctl.task.pybullet.library import pybullet
from tests.checking.judging import case, check_case, findings, found, mark_slow, rules_of

RULES = set(rules_of("RL8"))
CART = "broken_physics.py:Cart"
CASES = [
    case("broken_physics.py:RL801NoGravity", ("RL801", "warning"), twin="broken_physics.py:RL801Flat", slow=True),
    case("broken_physics.py:RL803InTheFloor", ("RL803", "warning"), twin=CART, slow=True),
    case(
        "broken_physics.py:RL804BeyondLimits",
        ("RL804", "warning"),
        twin="broken_physics.py:RL804TurnsWithoutEnd",
        slow=True,
    ),
    case("broken_physics.py:RL805Explodes", ("RL805", "warning"), twin=CART, slow=True),
    case("broken_physics.py:RL813LongPhysicsSteps", ("RL813", "warning"), twin=CART, slow=True),
    *(
        case(f"broken_overlaps.py:{name}", ("RL803", "warning"), twin=twin, pybullet=True, slow=True)
        for name, twin in (
            ("RL803PusherSinksItsCube", "robots.py:Pusher"),
            ("RL803CrawlerSinks", "robots.py:Crawler"),
            ("RL803ArmSinksItsCube", "broken_overlaps.py:ArmAboveCube"),
        )
    ),
    case("broken_physics.py:RL807StartsInTheFloor", ("RL807", "warning"), twin=CART, slow=True),
    case("broken_models.py:RL809HeavyInertia", ("RL809", "warning"), twin="broken_models.py:CartTask", slow=True),
    case("broken_models.py:RL809TipWithoutInertial", ("RL809", "info"), twin="broken_models.py:CartTask", slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


CLEAN = ["broken_physics.py:FixedCart", "broken_physics.py:ThroughBulletClient"]


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("task", CLEAN)
def test_worlds_without_a_mistake_are_clean(task):
    assert found(task, *rules_of("RL8")) == set()


def the_finding(name):
    return next(each for each in findings(f"broken_physics.py:{name}", *sorted(RULES)) if each.rule in RULES)


@pytest.mark.slow
@pytest.mark.pybullet
def test_joint_beyond_its_limits_is_placed():
    finding = the_finding("RL804BeyondLimits")
    # Actions are within +-1, and an action of 1 sets 1.8 rad.
    assert finding.evidence["joint"] == "shoulder of cart"
    assert finding.evidence["expected"] == [-1.0, 1.0]
    assert abs(finding.evidence["value"]) == pytest.approx(1.8)
    assert finding.evidence["actions"] == "extreme"
    assert {"seed", "episode", "step"} <= finding.evidence.keys()


@pytest.mark.slow
@pytest.mark.pybullet
def test_penetration_is_measured():
    finding = the_finding("RL803InTheFloor")
    # Set back to 5 cm every step, of which the solver takes away a fifth.
    assert finding.evidence["value"] == pytest.approx(0.04, abs=0.003)
    assert finding.evidence["expected"] == 0.02
    assert "for 30 steps in a row" in finding.message


@pytest.mark.slow
@pytest.mark.pybullet
def test_explosion_is_measured():
    finding = the_finding("RL805Explodes")
    # PyBullet stops at 100 m/s along each of three axes.
    assert finding.evidence["value"] == pytest.approx(100 * 3**0.5, rel=0.01)
    assert finding.message.startswith("link0 moves at 173.")


@pytest.mark.slow
@pytest.mark.pybullet
def test_calls_that_run_without_the_client_are_found():
    assert found("broken_physics.py:ForgetsClient", "RL808") == {("RL808", "error")}
    assert found("broken_physics.py:OverridesForgetful", "RL808") == set()


SOURCE = """
import pybullet as p
from pybullet_utils.bullet_client import BulletClient

def wrong(client):
    p.setGravity(0, 0, -10)
    return [p.getNumBodies()
            for each in range(3)]

def right(client):
    p.setGravity(0, 0, -10, client)
    p.stepSimulation(**{"physicsClientId": client})
    p.stepSimulation(client)
    p.getEulerFromQuaternion((0, 0, 0, 1))
    p.computeViewMatrix((1, 1, 1), (0, 0, 0), (0, 0, 1))
    world = BulletClient(p.DIRECT)
    world.stepSimulation()
    world.disconnect()
"""


@pytest.mark.pybullet
def test_calls_are_recorded_as_they_are_meant(tmp_path):
    file = tmp_path / "calls.py"
    file.write_text(SOURCE)
    names = {"__name__": "calls"}
    exec(compile(SOURCE, str(file), "exec"), names)
    client = pybullet.connect(pybullet.DIRECT)
    with record_calls() as calls:
        names["right"](client)
        assert calls.without_client == set()
        names["wrong"](client)
    pybullet.disconnect(client)
    assert [(call.line, call.name) for call in sorted(calls.without_client)] == [(6, "setGravity"), (7, "getNumBodies")]
    assert inspect.isbuiltin(pybullet.stepSimulation)


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_frame_without_inertial_is_named():
    (finding,) = findings("broken_models.py:RL809TipWithoutInertial", "RL809")
    assert finding.message == "cart_without_inertial.urdf: links without <inertial> weigh 1 mg: 'tip'"
    assert finding.evidence == {}


@pytest.mark.slow
def test_a_joint_without_effort_limit_is_named():
    (finding,) = findings("broken_models.py:NoEffort", "RL207")
    assert "cart_without_effort.urdf gives no effort limit for joint 'shoulder'" in finding.message
    assert "pass max_force= [N m]" in finding.message


@pytest.mark.slow
@pytest.mark.pybullet
def test_impossible_inertia_is_named():
    (finding,) = findings("broken_models.py:RL809HeavyInertia", "RL809")
    # An arm of 0.2 kg, 0.04 m x 0.04 m x 0.2 m, can have at most 0.2 * (0.04^2 + 0.04^2 + 0.2^2) = 0.0087 kg m^2.
    assert "a moment of 1 kg m^2 is more than 0.2 kg within 0.21 m can have" in finding.message


@pytest.mark.parametrize(("beyond", "is_outside"), [(0.11, False), (0.25, True)])
def test_a_wide_range_does_not_excuse_a_joint_beyond_its_limit(beyond, is_outside):
    """A tenth of the range of joint 6 of the KUKA iiwa, 2 * 2.094 rad, is more than PyBullet lets a motor push it."""
    joint = Joint(5, "joint_6", True, -2.094, 2.094)
    assert (measure_outside(joint, np.array([2.094 + beyond]))[0] > 0) == is_outside
