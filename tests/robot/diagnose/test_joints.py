"""A driver that exchanges or reverses joints: what the policy sees of it, by hand, and that it is found."""

import numpy as np
import pytest

from rlctl.policy.file import PolicyFile
from rlctl.policy.shipped import find_shipped_policy
from rlctl.task.joints import Joints
from rlctl_robot.diagnose.candidates import TermStatistics, list_candidates, list_joint_mistakes, list_joint_orders
from rlctl_robot.diagnose.correction import correct
from rlctl_robot.diagnose.diagnose import Doctor
from rlctl_robot.diagnose.joints import judge
from rlctl_robot.diagnose.physics import make_physics
from rlctl_robot.diagnose.reference import measure_statistics
from rlctl_robot.diagnose.signals import LoggedSignals
from tests.benchmarks.broken_logs import Robot, Wrong
from tests.limits.conftest import make_arm

POSE, SCALE = np.array([0.1, 0.5]), np.array([0.2, 0.4])


@pytest.fixture
def info():
    joints = Joints(
        ["shoulder", "elbow"], default_positions=POSE.tolist(), action_scale=SCALE.tolist(), measured="positions"
    )
    return make_arm().model_copy(update={"joints": joints})


@pytest.fixture
def statistics():
    names = {"positions": 2, "joint_velocities": 2, "goal": 3, "actions": 2}
    return {name: TermStatistics(np.zeros(size), np.ones(size)) for name, size in names.items()}


def find(mistakes, text):
    return next(one for one in mistakes if text in one.text)


def test_a_driver_that_exchanges_angles_changes_every_quantity_of_the_joints(info, statistics):
    mistake = find(list_joint_mistakes(info, statistics), "before the stance")
    assert mistake.describe() == (
        "joints: elements 0 and 1 (shoulder and elbow) are swapped in positions, joint_velocities and actions, "
        "before the stance is subtracted"
    )
    positions, velocities, actions = mistake.parts
    # The driver returns the angles [0.7, 0.3] as [0.3, 0.7]: the policy sees [0.3 - 0.1, 0.7 - 0.5] = [0.2, 0.2].
    assert positions.change(np.array([0.2, 0.2])) == pytest.approx([0.6, -0.2])  # 0.7 - 0.1 and 0.3 - 0.5
    assert velocities.change(np.array([1.0, 2.0])).tolist() == [2.0, 1.0]
    # Action [1, 1] are the targets [0.3, 0.9]. The robot goes to [0.9, 0.3]: actions 0.8 / 0.2 and -0.2 / 0.4.
    assert actions.change(np.array([1.0, 1.0])) == pytest.approx([4.0, -0.5])


def test_a_driver_that_reverses_a_joint(info, statistics):
    mistakes = list_joint_mistakes(info, statistics)
    mistake = find(mistakes, "element 1 has the wrong sign (elbow)")
    # The angle 0.7 is returned as -0.7, of which the policy sees -0.7 - 0.5 = -1.2.
    assert mistake.parts[0].change(np.array([0.0, -1.2])) == pytest.approx([0.0, 0.2])
    plain = [one for one in mistakes if "stance" not in one.text and "element 1 has" in one.text]
    assert plain[0].parts[2].change(np.array([1.0, 1.0])).tolist() == [1.0, -1.0]


def test_a_joint_mistake_corrects_a_log_as_its_parts_do(info, statistics):
    mistake = find(list_joint_mistakes(info, statistics), "before the stance")
    observations = np.array([[0.2, 0.2, 1.0, 2.0]])
    log = LoggedSignals(observations, np.array([[1.0, 1.0]]), (1,), {"positions": 2, "joint_velocities": 2})
    corrected = correct(log, [mistake], on_robot=True)
    assert corrected.observations[0] == pytest.approx([0.6, -0.2, 2.0, 1.0])
    assert corrected.actions[0] == pytest.approx([4.0, -0.5])


def test_a_task_without_joints_has_no_such_mistakes(info, statistics):
    assert list_joint_mistakes(info.model_copy(update={"joints": None}), statistics) == []
    del statistics["positions"], statistics["joint_velocities"]
    assert list_joint_mistakes(info, statistics) == []


def test_a_program_may_exchange_joints_in_one_term_alone(info, statistics):
    orders = list_joint_orders(info, statistics, list_candidates(info, statistics))
    assert {one.term for one in orders} == {"positions", "joint_velocities", "actions"}
    assert {one.kind for one in orders} == {"order"}


@pytest.fixture(scope="module")
def walker():
    return Robot("walk")


def record(walker, wrongs, seed, **options):
    log = walker.log(wrongs, 4.0, seed, **options)
    return LoggedSignals(log.observations, log.actions, log.lengths, log.sizes)


def swap(one, other):
    order = list(range(12))
    order[one], order[other] = other, one
    names = ("joint_positions", "joint_velocities", "actions")
    return [Wrong(name, "swap", order=tuple(order)) for name in names]


@pytest.mark.slow
@pytest.mark.parametrize("randomized", [False, True])
def test_the_simulation_tells_which_joints_are_exchanged(walker, randomized):
    info = PolicyFile.read(find_shipped_policy("walk")).info.env
    sound = record(walker, [], 1, randomized=True, noise=0.02)
    statistics = measure_statistics(sound)
    physics = make_physics(walker.spec, info, statistics, sound)
    assert physics is not None
    mistakes = [one for one in list_joint_mistakes(info, statistics) if "swapped" in one.text]
    left_right = record(walker, swap(1, 4), 2, randomized=randomized, noise=0.02)
    judgement = judge(physics, left_right, [], mistakes)
    assert "elements 1 and 4 (FR_upper_joint and FL_upper_joint) are swapped" in judgement.found[0].correction.text
    healthy = judge(physics, record(walker, [], 3, randomized=randomized, noise=0.02), [], mistakes)
    assert healthy.found == ()
    physics.close()


def swap_targets(walker, one, other):
    order = list(range(12))
    order[one], order[other] = other, one
    joints = walker.info.env.joints
    pose, scale = np.array(joints.default_positions), np.array(joints.action_scale)
    return Wrong("actions", "swap", order=tuple(order), offset=tuple(((pose[order] - pose) / scale).tolist()))


@pytest.mark.slow
def test_a_program_that_exchanges_targets_alone(walker):
    """Relations of signals prefer other causes: the robot falls, where they are not linear."""
    doctor = Doctor(walker.policy_file, walker.spec, steps=4000)
    log = walker.log([swap_targets(walker, 2, 3)], 20.0, 40_015, randomized=True)
    findings, _, mapping = doctor.diagnose(LoggedSignals(log.observations, log.actions, log.lengths, log.sizes))
    assert findings[0].text == "actions: elements 2 and 3 are swapped, among the joints' targets"
    assert mapping.actions.order == [0, 1, 3, 2, *range(4, 12)]
    parts = 34  # rows of each episode: too few for the simulation
    ends = np.cumsum(log.lengths)
    starts = [end - length for end, length in zip(ends, log.lengths, strict=True) if length >= parts]
    rows = np.concatenate([np.arange(start, start + parts) for start in starts])
    short = LoggedSignals(log.observations[rows], log.actions[rows], (parts,) * len(starts), log.sizes)
    findings, answers, _ = doctor.diagnose(short)
    doctor.close()
    assert not [finding for finding in findings if finding.kind in ("order", "sign", "scale", "offset")]
    assert answers.unexplained.startswith("the log cannot tell: no part of it has 36 rows")
