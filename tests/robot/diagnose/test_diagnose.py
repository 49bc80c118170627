"""Mistakes in the mapping of `reach`, in the closed loop and in the log alone, are named; a sound log has none."""

import json

import numpy as np
import pytest

from rlctl.cli import run
from rlctl_robot.diagnose.diagnose import Doctor
from rlctl_robot.diagnose.signals import LoggedSignals
from tests.benchmarks.broken_logs import Robot, Wrong

SWAPPED = (0, 1, 2, 4, 3, 5, 6)


@pytest.fixture(scope="module")
def robot():
    return Robot("reach")


@pytest.fixture(scope="module")
def doctor(robot):
    return Doctor(robot.policy_file, robot.spec, steps=4000)


def diagnose(doctor, robot, *wrongs, seconds=4.0, seed=5, randomized=False):
    log = robot.log(wrongs, seconds, seed, randomized=randomized, noise=0.02)
    return doctor.diagnose(LoggedSignals(log.observations, log.actions, log.lengths, log.sizes))


@pytest.mark.slow
@pytest.mark.parametrize("randomized", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_sound_log_has_no_finding(doctor, robot, randomized):
    findings, answers, mapping = diagnose(doctor, robot, randomized=randomized)
    assert findings == []
    assert answers.policy_difference < 1e-4
    assert mapping.model_dump(exclude_defaults=True) == {}


@pytest.mark.slow
def test_a_swap_in_the_closed_loop(doctor, robot):
    findings, answers, mapping = diagnose(doctor, robot, Wrong("joint_velocities", "swap", order=SWAPPED))
    assert findings[0].text == "joint_velocities: elements 3 and 4 are swapped"
    assert answers.policy_difference < 1e-4  # the policy received the swapped values
    assert mapping.observations["joint_velocities"].order == list(SWAPPED)


@pytest.mark.slow
def test_a_swap_in_the_log_alone_is_found_with_the_policy(doctor, robot):
    findings, answers, mapping = diagnose(doctor, robot, Wrong("joint_velocities", "swap", order=SWAPPED, in_log=True))
    assert findings[0].text.startswith("joint_velocities: elements 3 and 4 are swapped (in the log")
    assert findings[0].question == 1
    assert answers.policy_difference > 0.1 > 1e-4 > answers.policy_difference_corrected
    assert mapping.log.observations["joint_velocities"].order == list(SWAPPED)
    assert mapping.observations == {}  # the policy received the right values


@pytest.mark.slow
def test_a_motor_with_the_wrong_sign(doctor, robot):
    factor = (1.0, -1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    findings, _, mapping = diagnose(doctor, robot, Wrong("actions", "sign", factor=factor))
    assert findings[0].text == "actions: element 1 has the wrong sign"
    assert findings[0].question == 3
    assert mapping.actions is not None
    assert mapping.actions.sign == list(factor)


@pytest.mark.slow
def test_degrees_and_a_frozen_sensor_in_one_log(doctor, robot):
    degrees = Wrong("joint_velocities", "unit", factor=(180 / np.pi,) * 7)
    findings, _, _ = diagnose(doctor, robot, degrees, Wrong("hand", "stuck", stuck=(2,)))
    assert findings[0].text.startswith("hand: element 2 is frozen at")
    assert "joint_velocities: is in degrees per second, the policy expects radians per second" in [
        finding.text for finding in findings
    ]


@pytest.mark.slow
def test_late_actions_in_a_log_that_also_misses_a_sensor(doctor, robot):
    """The policy received what the log does not hold: its actions are matched with the values that suit them best."""
    late = Wrong("actions", "late", late=2, in_log=True)
    findings, _, mapping = diagnose(doctor, robot, Wrong("hand", "stuck", stuck=(2,), in_log=True), late)
    assert findings[0].text.startswith("hand: element 2 is frozen at")
    assert "actions: the log holds each action 2 control steps late" in [finding.text for finding in findings]
    assert mapping.log.actions.delay == 2
    assert mapping.actions is None


@pytest.mark.slow
def test_actions_of_another_policy_are_not_explained_by_a_correction(doctor, robot):
    log = robot.log((), 6.0, 7, randomized=False)
    rng = np.random.default_rng(0)
    weights = rng.standard_normal((20, 7))
    signals = LoggedSignals(log.observations, np.tanh(log.observations @ weights), log.lengths, log.sizes)
    findings, _, _ = doctor.diagnose(signals)
    assert any(finding.kind == "policy" and "another policy file" in finding.text for finding in findings)


@pytest.mark.slow
def test_the_command_line(tmp_path, robot, capsys):
    log = robot.log([Wrong("joint_velocities", "swap", order=SWAPPED)], 6.0, 5, randomized=True)
    np.savez(tmp_path / "log.npz", observations=log.observations, actions=log.actions)
    file = tmp_path / "result.json"
    arguments = ["diagnose", str(tmp_path / "log.npz"), "--policy", "reach", "--pretrained", "--json", str(file)]
    assert run(arguments) == 1
    result = json.loads(file.read_text())
    assert result["findings"][0]["text"] == "joint_velocities: elements 3 and 4 are swapped"
    assert result["mapping"] == {"observations": {"joint_velocities": {"order": list(SWAPPED)}}}


def test_a_missing_log_is_said_before_a_missing_policy(capsys):
    assert run(["diagnose", "no.csv", "--policy", "nothing"]) == 5
    assert capsys.readouterr().err == "error: no.csv: no such file or folder\n"
