"""RL8, and RL613: each rule finds its mistake in a PyBullet world, with the right numbers."""

import ast

import pytest

from rlctl.check_env.studies.bullet_calls import Reader, takes_client
from tests.check_env.judging import case, check_case, found, verdict_of

PARTS = ("probe", "instances")
RULES = {f"RL{number}" for number in (613, *range(801, 811))}
CART = "broken_physics.py:Cart"
CASES = [
    case("broken_physics.py:NoGravity", ("RL801", "warning"), twin="broken_physics.py:Flat"),
    case("broken_physics.py:NoCollisions", ("RL802", "warning"), twin="broken_physics.py:OnlySomeGroups"),
    case("broken_physics.py:InTheFloor", ("RL803", "warning"), twin=CART),
    case("broken_physics.py:BeyondLimits", ("RL804", "warning"), twin=CART),
    case("broken_physics.py:Explodes", ("RL805", "warning"), twin=CART),
    case("broken_physics.py:FrictionOfNothing", ("RL806", "warning"), twin="broken_physics.py:FrictionOfAll"),
    case("broken_physics.py:MassWithoutBase", ("RL806", "warning"), twin="broken_physics.py:MassOfAll"),
    case("broken_physics.py:FixedBaseGetsMass", ("RL806", "warning"), twin="broken_physics.py:FixedCart"),
    case("broken_physics.py:StartsInTheFloor", ("RL807", "warning"), twin=CART),
    case("broken_physics.py:Drops", ("RL807", "info"), twin=CART),
    case("broken_physics.py:ReadsCentre", ("RL809", "info"), twin="broken_physics.py:ReadsFrame"),
    case("broken_physics.py:ForceAtOrigin", ("RL810", "warning"), twin=CART),
    case("broken_physics.py:YawAsVelocity", ("RL613", "warning"), twin="broken_physics.py:TermsOfReward"),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.parametrize("name", ["FixedCart", "ThroughBulletClient"])
def test_worlds_without_a_mistake_are_clean(name):
    assert found(f"broken_physics.py:{name}") == set()


def the_finding(name):
    return next(each for each in verdict_of(f"broken_physics.py:{name}", PARTS).findings if each.rule in RULES)


def test_joint_beyond_its_limits_is_placed():
    finding = the_finding("BeyondLimits")
    # Actions are within +-1, and an action of 1 sets 1.8 rad.
    assert finding.evidence["joint"] == "shoulder"
    assert finding.evidence["expected"] == [-1.0, 1.0]
    assert abs(finding.evidence["value"]) == pytest.approx(1.8)
    assert finding.evidence["actions"] == "extreme"
    assert {"seed", "episode", "step"} <= finding.evidence.keys()


def test_penetration_is_measured():
    finding = the_finding("InTheFloor")
    # Set back to 5 cm every step, of which the solver takes away a fifth.
    assert finding.evidence["value"] == pytest.approx(0.04, abs=0.003)
    assert finding.evidence["expected"] == 0.02
    assert "for 30 steps in a row" in finding.message


def test_explosion_is_measured():
    finding = the_finding("Explodes")
    # PyBullet stops at 100 m/s along each of three axes.
    assert finding.evidence["value"] == pytest.approx(100 * 3**0.5, rel=0.01)
    assert finding.message.startswith("link0 moves at 173.")


def test_drop_is_measured():
    finding = the_finding("Drops")
    # 0.5 m high, of which 5 cm are the lower half of the box.
    assert finding.evidence["value"] == pytest.approx(0.45, abs=0.02)


def test_base_that_is_left_out_is_weighed():
    finding = the_finding("MassWithoutBase")
    assert finding.evidence == {"body": "cart", "link": "box", "value": 2.0, "links": 2}
    assert "2 kg and 89% of all" in finding.message  # 2 / (2 + 0.2 + 0.05), give or take a fifth of the latter


def test_centre_of_the_link_that_is_read():
    finding = the_finding("ReadsCentre")
    # The arm's is 10 cm away, but only the tip is read.
    assert (finding.evidence["link"], finding.evidence["value"]) == ("tip", pytest.approx(0.05))


def test_reward_term_is_named_with_what_it_is():
    finding = the_finding("YawAsVelocity")
    assert finding.evidence["term"] == "reward_terms/forward_velocity"
    assert finding.evidence["slope"] == pytest.approx(2.0)
    assert "yaw of cart" in finding.message


SOURCE = """
import pybullet as p
from pybullet import stepSimulation as go, getEulerFromQuaternion
from pybullet_utils.bullet_client import BulletClient

def wrong(self):
    p.setGravity(0, 0, -10)
    go()
    p.getLinkState(self.arm, 3)[0]
    hand, turn, *rest = p.getLinkState(self.arm, 3, physicsClientId=self.client)

def right(self):
    p.connect(p.DIRECT)
    p.disconnect(self.number)
    p.setGravity(0, 0, -10, self.client)
    p.stepSimulation(**self.own)
    getEulerFromQuaternion((0, 0, 0, 1))
    p.computeViewMatrix((1, 1, 1), (0, 0, 0), (0, 0, 1))
    self.p.stepSimulation()
    state = p.getLinkState(self.arm, 3, physicsClientId=self.client)
    return state[0], state[4]

def rebound(self):
    p = BulletClient()
    p.stepSimulation()
    p.applyExternalForce(self.arm, -1, [1, 0, 0], [0, 0, 0], flags=LINK_FRAME)

def argument(p):
    p.stepSimulation()
    p.applyExternalForce(self.arm, -1, [1, 0, 0], np.zeros(3), p.WORLD_FRAME)
"""


def test_calls_are_read_as_they_are_meant():
    pybullet = pytest.importorskip("pybullet")
    tree = ast.parse(SOURCE)
    reader = Reader(tree, takes_client(pybullet))
    read = [(what, call.lineno) for part in tree.body for what, call in reader.read(part)]
    assert sorted(read) == [
        *(("centre_as_frame", 9), ("centre_as_frame", 10), ("force_at_origin", 30)),
        *(("without_client", 7), ("without_client", 8), ("without_client", 9)),
    ]
