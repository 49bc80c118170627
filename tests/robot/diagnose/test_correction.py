"""Corrections and the mapping that they make together, computed by hand."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from rlctl.errors import AnswerIsNo
from rlctl.task.joints import Joints
from rlctl_robot.diagnose.candidates import FROM_W_FIRST, list_permutations, make_scale, make_sign
from rlctl_robot.diagnose.correction import Correction, correct
from rlctl_robot.diagnose.diagnose import (
    Answers,
    Diagnosis,
    MappingFinding,
    _describe_on_robot,
    _has_large_gain,
    _mark_weak,
)
from rlctl_robot.diagnose.mapping import build_mapping, compose, invert
from rlctl_robot.diagnose.report import describe_answers, describe_mapping, describe_verdict, write_mapping
from rlctl_robot.diagnose.signals import LoggedSignals, shift

ARM = Joints(["a", "b", "c"], default_positions=[0.1, 0.5, 0.0], action_scale=[0.2, 0.4, 1.0], measured="q")
SWAP = Correction("q", "order", "", order=(1, 0, 2))
AFFINE = Correction("q", "scale", "", factor=(2.0, -1.0, 1.0), offset=(0.5, 0.0, 0.0))


def make_signals(observations, actions, lengths=None):
    return LoggedSignals(np.array(observations, float), np.array(actions, float), lengths or (len(actions),), {"q": 3})


def test_a_correction_orders_then_scales_then_shifts_and_undo_is_its_inverse():
    # [10, 20, 30] -> [20, 10, 30] by SWAP; -> [2 * 10 + 0.5, -20, 30] by AFFINE.
    values = np.array([10.0, 20.0, 30.0])
    assert SWAP.change(values).tolist() == [20, 10, 30]
    assert AFFINE.change(values).tolist() == [20.5, -20, 30]
    assert AFFINE.undo(AFFINE.change(values)).tolist() == values.tolist()
    turned = Correction("q", "order", "", order=(1, 2, 0))
    assert turned.undo(turned.change(values)).tolist() == values.tolist()


def test_delays_stay_inside_a_segment():
    values = np.arange(6.0)
    assert shift(values, 1, (3, 3)).tolist() == [1, 2, 2, 4, 5, 5]
    assert shift(values, -2, (3, 3)).tolist() == [0, 0, 0, 3, 3, 3]


def test_actions_late_in_the_log_move_up_and_late_on_the_robot_move_down():
    signals = make_signals(np.zeros((4, 3)), [[1], [2], [3], [4]])
    late = Correction("actions", "delay", "", delay=1)
    assert correct(signals, [late]).actions.ravel().tolist() == [2, 3, 4, 4]
    assert correct(signals, [late], on_robot=True).actions.ravel().tolist() == [1, 1, 2, 3]


def test_a_frame_is_turned_with_the_logged_attitude():
    # Yaw of 90 degrees: forward in the world (1, 0, 0) is right of a body that looks along y: (0, -1, 0).
    signals = LoggedSignals(
        np.array([[1.0, 0, 0, 0, 0, np.pi / 2]]), np.zeros((1, 1)), (1,), {"velocity": 3, "attitude": 3}
    )
    one = Correction("velocity", "frame", "", frame="to body", attitude="attitude")
    assert correct(signals, [one]).observations[0, :3] == pytest.approx([0, -1, 0])


def test_several_corrections_compose_to_one_mapping():
    mapping = compose([SWAP, AFFINE])
    value = np.array([10.0, 20.0, 30.0])
    composed = np.array(mapping.sign) * np.array(mapping.scale) * value[mapping.order] + np.array(mapping.offset)
    assert composed.tolist() == AFFINE.change(SWAP.change(value)).tolist() == [40.5, -10, 30]


def test_what_is_sent_to_a_robot_is_the_inverse_of_what_it_does():
    robot = Correction("actions", "scale", "", order=(2, 0, 1), factor=(1.0, -2.0, 4.0))
    mapping = invert([robot])
    wanted = np.array([1.0, 2.0, 3.0])
    sent = np.array(mapping.sign) * np.array(mapping.scale) * wanted[mapping.order]
    assert robot.change(sent) == pytest.approx(wanted)


def test_the_mapping_of_a_swap_has_only_its_order():
    mapping = build_mapping([], [SWAP], {"q": 3}).model_dump(exclude_defaults=True)
    assert mapping == {"observations": {"q": {"order": [1, 0, 2]}}}


def test_mistakes_of_the_log_alone_do_not_change_what_a_program_must_do():
    everything = Correction("observation", "normalised", "", factor=(2.0, 2.0, 2.0, 3.0), offset=(0.0, 0.0, 0.0, 1.0))
    mapping = build_mapping([everything], [SWAP], {"q": 3, "v": 1}).model_dump(exclude_defaults=True)
    assert mapping == {
        "observations": {"q": {"order": [1, 0, 2]}},
        "log": {"observations": {"q": {"scale": 2.0}, "v": {"scale": 3.0, "offset": 1.0}}},
    }


def test_orders_of_legs_joints_and_names_are_tried():
    names = [f"{leg}_{joint}" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf")]
    orders = list_permutations(12, names)
    assert "the joints are in alphabetical order" in orders.values()
    # Logged FL, FR, RL, RR; the policy has FR, FL, RR, RL.
    assert orders[(3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)] == "groups of 3 elements are in the order 1, 0, 3, 2"
    # Logged all hips, then all thighs, then all calves: element 1, FR's thigh, is the fifth of the log.
    by_kind = next(order for order, text in orders.items() if "grouped by kind, 4 of each" in text)
    assert by_kind[:3] == (0, 4, 8)


def test_texts_name_elements():
    assert make_sign("q", 3, [1]).describe() == "q: element 1 has the wrong sign"
    assert make_scale("q", 3, range(3), 0.5).describe() == "q: all elements are 2 times too large"
    text = make_scale("actions", 3, [2], 0.5).describe()
    assert text == "actions: element 2 acts 0.5 times as strongly as in simulation"


def test_the_targets_of_a_controller_are_mapped_as_the_actions_are():
    # The robot moves a with what it gets for b, b with c, c with a: it must get a's target for c, b's for a, c's for b.
    order, pose, scale = (1, 2, 0), np.array(ARM.default_positions), np.array(ARM.action_scale)
    there = list(order)
    factor, offset = scale[there] / scale, (pose[there] - pose) / scale
    angles = Correction("actions", "order", "", order=order, factor=tuple(factor), offset=tuple(offset))
    mapping = build_mapping([], [angles], {"q": 3}, ARM)
    assert mapping.targets.model_dump(exclude_defaults=True) == {"order": [2, 0, 1]}
    sent = np.array([0.3, 0.7, -0.2])[mapping.targets.order]
    assert sent[there].tolist() == [0.3, 0.7, -0.2]


def test_targets_of_steps_are_known_only_if_the_measured_angles_are_exchanged_too():
    steps = Joints(["a", "b", "c"], default_positions=[0.1, 0.5, 0.0], action_step=[0.1] * 3, measured="q")
    swap = Correction("actions", "order", "", order=(1, 0, 2))
    assert build_mapping([], [swap], {"q": 3}, steps).targets is None
    both = Correction("joints", "order", "", parts=(SWAP, swap))
    mapping = build_mapping([], [both], {"q": 3}, steps)
    assert mapping.targets.order == mapping.observations["q"].order == mapping.actions.order == [1, 0, 2]


def test_the_mapping_of_a_controller_is_of_angles():
    # q = angle - pose. Exchanged angles: q = logged[order] + pose[order] - pose; the angles themselves have no offset.
    offset = np.array([0.4, -0.4, 0.0])
    angles = Correction("q", "order", "", order=(1, 0, 2), offset=tuple(offset))
    of_policy = build_mapping([], [angles], {"q": 3}, ARM).observations["q"]
    assert of_policy.offset == offset.tolist()
    of_controller = build_mapping([], [angles], {"q": 3}, ARM, is_of_controller=True).observations["q"]
    assert of_controller.model_dump(exclude_defaults=True) == {"order": [1, 0, 2]}


def test_a_large_gain_of_an_action_is_named_and_not_corrected():
    weak = make_scale("actions", 3, [2], 0.18)
    assert _has_large_gain(weak)
    assert _has_large_gain(make_scale("actions", 3, [2], 5.5))
    assert not _has_large_gain(make_scale("actions", 3, [2], 0.6))
    assert not _has_large_gain(make_scale("q", 3, [2], 0.18))
    assert "acts 0.18 times as strongly as in simulation (not in the mapping" in _describe_on_robot(weak)


def make_finding(explains, evidence, question=2):
    return MappingFinding(question, "q", "order", "q: wrong", evidence, explains)


def test_what_a_main_finding_may_have_caused_is_checked_again():
    findings = [make_finding(0.96, 900.0), make_finding(0.71, 300.0), make_finding(0.9, 40.0), make_finding(0.9, 500.0)]
    assert [one.is_weak for one in _mark_weak(findings)] == [False, True, True, False]
    assert not any(one.is_weak for one in _mark_weak([make_finding(0.6, 900.0), make_finding(0.3, 90.0)]))


@pytest.mark.parametrize(
    ("findings", "unexplained", "message"),
    [
        ([make_finding(0.96, 900.0), make_finding(0.0, 1e4, 1)], "", "log.csv: 1 mistake in the mapping"),
        ([make_finding(0.0, 1e4, 1)], "", "log.csv: something differs, the cause is unknown"),
        ([], "errors are 1.19 times the usual ones", "log.csv: something differs, the cause is unknown"),
    ],
)
def test_only_what_explains_something_is_a_mistake_of_the_mapping(findings, unexplained, message):
    answers = Answers(0.0, 0.0, {}, (1.0, 1.0), unexplained)
    mapping = build_mapping([], [], {})
    diagnosis = Diagnosis(Path("log.csv"), "p", "t", 100, 1.0, (), answers, tuple(findings), mapping)
    with pytest.raises(AnswerIsNo, match=message):
        diagnosis.check()


def test_a_unit_of_measured_angles_has_no_offset_for_a_controller():
    degree, pose = np.pi / 180, np.array(ARM.default_positions)
    unit = Correction("q", "unit", "", factor=(degree,) * 3, offset=tuple((degree - 1) * pose))
    of_controller = build_mapping([], [unit], {"q": 3}, ARM, is_of_controller=True).observations["q"]
    assert of_controller.model_dump(exclude_defaults=True) == {"scale": 0.017453}


def test_a_controllers_program_gets_one_mapping_of_what_it_sends():
    swap = Correction("actions", "order", "", order=(1, 0, 2), offset=(2.0, -1.0, 0.0), factor=(2.0, 0.5, 1.0))
    both = build_mapping([], [swap], {"q": 3}, ARM)
    assert both.actions is not None
    assert both.targets is not None
    of_controller = build_mapping([], [swap], {"q": 3}, ARM, is_of_controller=True)
    assert of_controller.actions is None
    assert of_controller.targets == both.targets


def test_the_elements_of_a_quaternion_are_named():
    w_first = Correction("orientation", "order", "", order=FROM_W_FIRST)
    # The program's 0, 1, 2, 3 are w, x, y, z: the policy's x is element 1.
    assert w_first.change(np.array([0.9, 0.1, 0.2, 0.3])).tolist() == [0.1, 0.2, 0.3, 0.9]
    mapping = build_mapping([], [w_first], {"gravity": 3}, is_of_controller=True, quaternions=["orientation"])
    assert mapping.model_dump(exclude_defaults=True) == {
        "observations": {"orientation": {"order": ["w", "x", "y", "z"]}}
    }


def make_diagnosis(answers, mapping, findings=()):
    return Diagnosis(Path("log.csv"), "p", "t", 100, 1.0, (), answers, tuple(findings), mapping)


def test_what_decided_is_what_is_printed():
    found = [make_finding(0.9, 900.0)]
    worse = make_diagnosis(Answers(0.0, 0.0, {"q": (1.0, 1.2)}, (1.35, 1.43)), build_mapping([], [], {}), found)
    lines = describe_answers(worse)
    assert lines[1] == "2. are the observations those of the simulation? yes"  # the finding has no correction
    assert lines[2].endswith("errors are 1.35 times the usual ones")
    simulated = dataclasses.replace(worse.answers, simulated_error=(3.2, 0.8))
    line = describe_answers(dataclasses.replace(worse, answers=simulated))[2]
    assert line.endswith(
        "better when corrected: errors are 3.2 times the largest errors of a sound robot as logged, 0.8 times corrected"
    )


def test_observations_of_exchanged_joints_are_not_those_of_the_simulation():
    parts = tuple(Correction(name, "order", "", order=(1, 0, 2)) for name in ("q", "v", "actions"))
    joints = Correction("joints", "order", "a and b are swapped", order=(1, 0, 2), parts=parts)
    found = dataclasses.replace(make_finding(0.9, 900.0, 3), text=joints.describe(), correction=joints)
    usual = Answers(0.0, 0.0, {"q": (1.0, 1.0)}, (1.0, 1.0), simulated_error=(0.905, 0.237))
    result = make_diagnosis(usual, build_mapping([], [], {}), [found])
    asked = "2. are the observations those of the simulation?"
    assert describe_answers(result)[1] == f"{asked} no, though each alone looks usual: q, v"
    of_actions = dataclasses.replace(found, correction=parts[2])
    assert describe_answers(dataclasses.replace(result, findings=(of_actions,)))[1] == f"{asked} yes"


@pytest.mark.parametrize(
    ("findings", "unexplained", "verdict"),
    [
        ([], "", "no mistake in the mapping found"),
        ([], "the robot falls", "something differs, the cause is unknown: the robot falls"),
        ([make_finding(0.0, 1e4, 1)], "", "something differs, the cause is unknown: q: wrong"),
        (
            [make_finding(0.96, 900.0), make_finding(0.85, 900.0)],
            "",
            "wrong is q: wrong (sure: it explains 96% of what differs, and nothing else that was tried does; "
            "1 more below)",
        ),
        ([make_finding(0.5, 9.0)], "", "wrong is q: wrong (likely, but it explains only 50% of what differs)"),
        (
            [dataclasses.replace(make_finding(0.9, 9.0), also=("v: late",))],
            "",
            "wrong is q: wrong (one of 2 causes that this log cannot tell apart)",
        ),
    ],
)
def test_the_verdict_says_what_is_wrong_and_how_sure(findings, unexplained, verdict):
    answers = Answers(0.0, 0.0, {}, (1.0, 1.0), unexplained)
    assert describe_verdict(make_diagnosis(answers, build_mapping([], [], {}), findings)) == verdict


def test_the_mapping_is_written_where_there_is_one(tmp_path, capsys):
    answers, file = Answers(0.0, 0.0, {}, (1.0, 1.0)), tmp_path / "mapping.yaml"
    write_mapping(make_diagnosis(answers, build_mapping([], [], {})), file)
    assert not file.exists()
    assert "not written: the mapping needs no correction" in capsys.readouterr().err
    write_mapping(make_diagnosis(answers, build_mapping([], [SWAP], {"q": 3})), file)
    assert file.read_text() == "observations:\n  q:\n    order: [1, 0, 2]\n"


def test_of_two_mappings_a_comment_says_which_one_a_program_uses():
    swap = Correction("actions", "order", "", order=(1, 0, 2))
    text = describe_mapping(build_mapping([], [swap], {"q": 3}, ARM))
    before, after = text.split("# the same for a program that sends targets of joints; it does not apply `actions`\n")
    assert before == "actions:\n  order: [1, 0, 2]\n"
    assert after.startswith("targets:\n  order: [1, 0, 2]\n")
