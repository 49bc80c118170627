"""Errors in `limits.yaml` name the line, what was expected, and the closest name."""

import pytest
from gymnasium import spaces

from rlctl.deploy import Limits, SafetyFilter, read_limits
from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.errors import ArtifactError, RecipeError
from rlctl.limits.doubts import list_doubts
from rlctl.task import terms
from rlctl.task.joints import Joints
from tests.limits.conftest import make_arm, observe_at

GOOD = """
command: position
joints: [shoulder, elbow]
limits:
  all: {speed: 2.0}
  elbow: {position: [-1, 1], speed: 1.0}
measured: {position: positions}
home: [0, 0]
sensors: {goal: {range: [-2, 2], frozen_s: 0.5}}
"""


@pytest.fixture
def write(tmp_path):
    def written(text):
        file = tmp_path / "limits.yaml"
        file.write_text(text)
        return file

    return written


def test_a_whole_file(write, arm):
    limits = read_limits(write(GOOD))
    assert limits.limits["elbow"].position == (-1.0, 1.0)
    SafetyFilter(arm, limits)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("comand: step", "limits.yaml:1: no key 'comand'. Did you mean 'command'? Keys here: command, scale"),
        (
            "command: steps",
            "limits.yaml:1: command: expected position or step or speed or torque or action or null, "
            "got 'steps'. Did you mean 'step'?",
        ),
        (
            "limits:\n  elbow: {position: [1, -1]}",
            "limits.yaml:2: limits.elbow.position: the lower bound 1 is not below the upper one, -1; write [low, high]",
        ),
        (
            "limits:\n  elbow: {speed: 90 deg/s}",
            "limits.yaml:2: limits.elbow.speed: expected a number > 0 [rad/s or m/s], got '90 deg/s'",
        ),
        ("limits:\n  elbow: {speed: -1}", "limits.elbow.speed: expected a number > 0 [rad/s or m/s], got -1"),
        ("limits:\n  elbow: {sped: 1}", "no key 'limits.elbow.sped'. Did you mean 'speed'?"),
        ("- 1", "limits.yaml:1: expected a mapping of command, scale, "),
        ("blend_in_s: .nan", "blend_in_s: expected a number >= 0 [s], got nan"),
    ],
)
def test_what_is_wrong_in_a_file(write, text, message):
    with pytest.raises(RecipeError) as error:
        read_limits(write(text))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("elbow: {", "elbo: {"), "limits: no joint 'elbo'. Did you mean 'elbow'? Known: shoulder, elbow."),
        (
            ("goal: {", "gaol: {"),
            "limits: sensors: no observation 'gaol'. Did you mean 'goal'? Known: positions, goal.",
        ),
        (("position: positions", "position: goal"), "measured.position: goal has 3 elements, the action has 2"),
        (("measured: {position: positions}\n", ""), "write measured: {position: NAME}"),
        (("home: [0, 0]", "home: [0]"), "home: 1 numbers, the action has 2 elements"),
        (("home: [0, 0]", "home: [0, 2]"), "home: outside the position limits"),
        (("home: [0, 0]", "on_fault: home"), "on_fault: home: it needs the home position"),
        (("joints: [shoulder, elbow]", "joints: [elbow, elbow]"), "1 different names, the action has 2 elements"),
        (("command: position", "command: torque"), "with command: torque only torque, rate, action can be limited"),
        (("[-1, 1]", "[20, 30]"), "elbow: no action keeps these limits and the policy's own action bounds"),
        (
            ("home: [0, 0]", "safe_action: [0, 0]"),
            "safe_action: leave it out; with command: position, it means no motion",
        ),
        (("home: [0, 0]", "scale: [1, 1, 1]"), "scale has 3 numbers, the action 2"),
    ],
)
def test_limits_that_a_policy_cannot_have(write, arm, change, message):
    with pytest.raises(RecipeError) as error:
        SafetyFilter(arm, write(GOOD.replace(*change)))
    assert message in str(error.value)


def test_what_the_task_knows_of_its_joints(write, arm):
    known = Joints(
        ["hip", "knee"],
        default_positions=[0.5, -1.0],
        action_scale=[0.25, 0.5],
        low=[-1, -2],
        high=[0.6, 0],
        max_speed=[9, 9],
    )  # fmt: skip
    arm = arm.model_copy(update={"joints": known})
    safety = SafetyFilter(arm, write("command: position\nlimits: {knee: {position: [-1.5, -0.5]}}"))
    safety.observe(observe_at(0, 0))
    # 0.5 + 0.25 * 0.2 and -1 + 0.5 * 0.2 are within; 0.5 + 0.25 * 2 = 1 is not below 0.6, which is 0.4 of the action.
    assert safety.limit([0.2, 0.2]) == pytest.approx([0.2, 0.2])
    assert safety.limit([2.0, -9.0]) == pytest.approx([0.4, -1.0])
    assert [(event.name, event.limit) for event in list(safety.events)[-2:]] == [
        ("hip.position", pytest.approx(0.6)),
        ("knee.position", pytest.approx(-1.5)),
    ]
    with pytest.raises(RecipeError, match="write them in the action's order: hip, knee"):
        SafetyFilter(arm, write("joints: [knee, hip]"))
    with pytest.raises(RecipeError, match="action 0 means no motion"):
        SafetyFilter(arm, write("{command: speed, offset: 1}"))


def test_what_limits_leave_out_comes_from_the_task(write, arm):
    known = Joints(["hip", "knee"], action_step=[0.1, 0.1], measured="angles", low=[-1, -2], high=[1, 2])
    scaled = {"positions": terms.Scaled("angles", offset=(0.5, 0.0))}
    described = arm.model_copy(update={"joints": known, "observation_terms": scaled})
    safety = SafetyFilter(described, write("limits: {all: {speed: 0.5}}"))
    assert (safety.limits.command, safety.limits.measured.position) == ("step", "positions")
    safety.observe(observe_at(0, 0))  # the hip at 0.5 rad
    assert safety.command.position == pytest.approx([0.5, 0.0])
    assert safety.limit([1.0, 0.2]) == pytest.approx([0.5, 0.2])  # 0.05 rad in 0.1 s
    assert SafetyFilter(described).limits.command == "action"  # without limits only the action is bounded
    assert SafetyFilter(arm, write("limits: {all: {rate: 0.5}}")).limits.command == "action"


def test_positions_in_degrees_are_out_of_range(write, arm):
    known = Joints(["hip", "knee"], action_step=[0.1, 0.1], measured="positions", low=[-1, 0], high=[2, 0])
    described = arm.model_copy(update={"joints": known})
    safety = SafetyFilter(described, write("limits: {all: {speed: 0.5}}"))
    # A joint may be a range of 3 rad outside its own, -1 to 2, but not in degrees; the knee has no range.
    assert safety.observe(observe_at(-3.9, 80))
    assert not safety.observe(observe_at(57, 0))
    assert safety.events[-1].name == "positions[0] out of range"
    assert safety.events[-1].limit == pytest.approx(5.0)
    assert not SafetyFilter(described).observe(observe_at(57, 0))  # without limits too
    own = SafetyFilter(described, write("sensors: {positions: {range: [-100, 100]}}"))
    assert own.observe(observe_at(57, 0))


def test_position_limits_stay_within_the_robot_models(write, arm):
    arm = arm.model_copy(update={"joints": Joints(["hip", "knee"], low=[-1, -2.6], high=[0.6, 2.6])})
    units = "command: position\nscale: 1\nmeasured: {position: positions}\n"
    with pytest.raises(RecipeError, match=r"knee\.position: -140 to 140 is not within the robot model's -2\.6 to 2\.6"):
        SafetyFilter(arm, write(units + "limits: {knee: {position: [-140, 140]}}"))
    SafetyFilter(arm, write(units + "limits: {knee: {position: [-2.61, 2.6]}}"))  # rounded
    safety = SafetyFilter(arm, write(units + "limits: {all: {position: [-2, 2]}}"))
    safety.observe(observe_at(0, 0))
    assert safety.limit([9.0, -9.0]) == pytest.approx([0.6, -2.0])
    with pytest.raises(RecipeError, match=r"hip\.position: 1 to 2 is not within"):
        SafetyFilter(arm, write(units + "limits: {all: {position: [1, 2]}}"))


def test_a_joint_without_limits_of_its_own(write, arm):
    known = Joints(["hip", "knee"], low=[0, -2], high=[-1, 0], max_speed=[0, 9], max_torque=[0, 3])
    arm = arm.model_copy(update={"joints": known})
    safety = SafetyFilter(arm, write("command: step\nmeasured: {position: positions}"))
    safety.observe(observe_at(0, 0))
    assert safety.limit([5.0, 5.0]) == pytest.approx([5.0, 0.0])
    assert SafetyFilter(arm, write("command: torque")).limit([5.0, 5.0]) == pytest.approx([5.0, 3.0])


def test_actions_from_minus_1_to_1_need_a_scale(write, arm):
    normalised = arm.model_copy(update={"action_space": space_to_json(spaces.Box(-1, 1, (2,)))})
    with pytest.raises(
        RecipeError, match=r"limits.yaml: limits: scale: required .* from -1 to 1; .* the torque of action 1 "
    ):
        SafetyFilter(normalised, write("command: torque\nlimits: {all: {torque: 8}}"))  # 1 of it may be 10 N m
    safety = SafetyFilter(normalised, write("command: torque\nscale: 10\nlimits: {all: {torque: 8}}"))
    safety.observe(observe_at(0, 0))
    assert safety.limit([0.9, 0.1]) == pytest.approx([0.8, 0.1])


def test_without_a_control_dt(write):
    info = EnvInfo(observation_space=make_arm().observation_space, action_space=space_to_json(spaces.Box(-1, 1, (2,))))
    with pytest.raises(RecipeError, match="has no control_dt"):
        SafetyFilter(info, write("lowpass_hz: 2"))


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ArtifactError, match="no such file"):
        read_limits(tmp_path / "none.yaml")


def test_a_scale_that_rounding_would_swallow(write, arm):
    with pytest.raises(RecipeError, match="scale is too small next to offset"):
        SafetyFilter(arm, write("{command: position, scale: 1.0e-10, offset: 100}"))


def test_positions_that_the_policy_observes_scaled_and_from_a_default_pose(write, arm):
    text = "command: position\nscale: 1\nlimits: {all: {speed: 1}}\nmeasured: {position: positions}"
    scaled = terms.Scaled("joint_positions", offset=(0.5, -0.5), scale=2.0)
    safety = SafetyFilter(arm.model_copy(update={"observation_terms": {"positions": scaled}}), write(text))
    safety.observe(observe_at(0.2, 0.0))
    # The joints are at 0.2 / 2 + 0.5 = 0.6 and -0.5 rad; 1 rad/s over 0.1 s from there.
    assert safety.limit([5.0, 5.0]) == pytest.approx([0.7, -0.4])
    gravity = arm.model_copy(update={"observation_terms": {"positions": terms.Gravity()}})
    with pytest.raises(RecipeError, match=r"measured\.position: positions is computed; positions cannot be read"):
        SafetyFilter(gravity, write(text))


def test_a_speed_in_degrees_is_doubted():
    info = make_arm().model_copy(update={"joints": Joints(["shoulder", "elbow"], max_speed=[28.6, 52.4])})
    limits = Limits.model_validate({"limits": {"all": {"speed": 687.0}, "elbow": {"speed": 60.0}}})
    [doubt] = list_doubts(limits, info)
    assert doubt.startswith(
        "warning: limits: all.speed: 687 is more than 5 times the top speed of the fastest joint, 52"
    )
