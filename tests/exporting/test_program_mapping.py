"""A controller maps a program's values to the policy's, and its targets back, as a file such as diagnose's says."""

import dataclasses

import numpy as np
import pytest

from rlctl.errors import RecipeError, RlctlError, UsageError
from rlctl.exporting.c_source import find_compiler
from rlctl.exporting.controller.controllers import CController, MappedController, OnnxController, compile_controller
from rlctl.exporting.controller.graph import build_graph
from rlctl.exporting.controller.plan import ControllerPlan
from rlctl.exporting.controller.program_mapping import read_mapping
from rlctl.exporting.controller.source import ControllerSource
from rlctl.exporting.onnx_source import make_metadata
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.policy.onnx_policy import encode
from rlctl.policy.policy import Policy
from rlctl.storage import yaml_text
from rlctl.task import Joints, terms
from rlctl_robot.diagnose.correction import Correction
from rlctl_robot.diagnose.mapping import build_mapping
from tests.exporting.controllers import make_arm, make_policy, plan_of

MAPPING = """
observations:
  goal: {order: [1, 2, 0], sign: [1, -1, 1], scale: [0.5, 1, 2], offset: [0, 0, 3]}
log: {observations: {positions: {order: [1, 0]}}}
"""


@pytest.fixture
def policy():
    return make_policy(make_arm())


@pytest.fixture
def mapping(policy, tmp_path):
    (tmp_path / "mapping.yaml").write_text(MAPPING)
    return read_mapping(tmp_path / "mapping.yaml", ControllerPlan(policy.info.env, policy.info.spec.frame_stack))


def test_values_and_their_inverse(mapping):
    maps = mapping.inputs
    assert list(maps) == ["goal"]  # what only the log has wrong is not changed
    # value = [0.5 * 20, -30, 2 * 10 + 3] for the input [10, 20, 30].
    assert maps["goal"].undo(np.array([10.0, -30.0, 23.0])).tolist() == [10, 20, 30]
    expected = "order [1, 2, 0], factor [0.5, -1, 2], offset [0, 0, 3]"
    assert maps["goal"].describe() == expected


@pytest.mark.slow
@pytest.mark.parametrize("form", ["onnx", "c"])
def test_a_controller_maps_its_inputs(policy, mapping, tmp_path, form):
    if form == "onnx":
        controller = OnnxController(encode(build_graph(policy, plan_of(policy), mapping)))
    else:
        if find_compiler() is None:
            pytest.skip("no C compiler")
        source = ControllerSource(policy, plan_of(policy), "controller", None, mapping)
        code = source.write()
        assert " *   goal: order [1, 2, 0]," in code.header
        controller = CController(source.plan, compile_controller(code, tmp_path, find_compiler()), has_target=False)
    right = {"positions": np.array([0.1, 0.2]), "goal": np.array([10.0, -30.0, 23.0])}
    wrong = {"positions": right["positions"], "goal": np.array([10.0, 20.0, 30.0])}
    expected = Policy(NumpyActor(policy)).predict(np.concatenate([*right.values()]).astype(np.float32))
    assert np.ravel(controller.step(wrong)[0]) == pytest.approx(expected, abs=1e-5)
    controller.begin()
    assert np.ravel(MappedController(controller, mapping).step(right)[0]) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("actions: {sign: [1, -1]}", UsageError, "of the policy's action; change the action where the program sends"),
        ("targets: {sign: [1, -1]}", UsageError, "the task does not describe what an action commands"),
        ("observations: {goal: {sign: [1, 2, 1]}}", RecipeError, "a sign is 1 or -1, not 2"),
        ("observations: {goal: {order: [x, y, z]}}", RecipeError, "the elements have no names"),
        ("observations: {goal: {like: positions}}", UsageError, "only targets can be like an observation"),
        ("observations: {gaol: {sign: [1, 1, 1]}}", RecipeError, "no input 'gaol'. Did you mean 'goal'"),
        ("observations: {goal: {sign: [1, 1]}}", RecipeError, "goal: sign has 2 numbers, not 3"),
        ("observations: {goal: {order: [0, 0, 1]}}", RecipeError, "must have each of 0 to 2 once"),
        ("observations: {goal: {scale: [1, 0, 1]}}", RecipeError, "scale must be positive"),
        ("observations: {goal: {delay: 1}}", UsageError, "delay 1: a controller cannot undo it"),
        ("observations: {goal: {frame: to body}}", UsageError, "frame to body: a controller cannot undo it"),
    ],
)
def test_what_does_not_fit(policy, tmp_path, text, error, message):
    (tmp_path / "mapping.yaml").write_text(text)
    with pytest.raises(error) as caught:
        read_mapping(tmp_path / "mapping.yaml", ControllerPlan(policy.info.env, policy.info.spec.frame_stack))
    assert message in str(caught.value)


TARGETS = """
observations:
  positions: {order: [right, left], sign: [-1, 1], scale: 0.5, offset: [0, 0.25], unit: half turns}
  orientation: {order: [w, x, y, z]}
targets: TARGET
"""
LIKE = "{like: positions}"
# The inverse, written out. Program: right = (position - 0.25) / 0.5, left = position / -0.5.
SAME = "{order: [right, left], sign: [1, -1], scale: 2, offset: [-0.5, 0], unit: half turns}"
INDEXED = "{order: [1, 0], sign: [1, -1], scale: [2, 2], offset: [-0.5, 0], unit: half turns}"


@pytest.fixture
def legs():
    joints = Joints(
        ["left", "right"], [0.1, -0.1], [0.5, 0.4], stiffness=[20, 30], low=[-9, -9], high=[9, 9], measured="positions"
    )
    terms_of = {"goal": terms.Gravity("orientation")}
    return make_policy(make_arm(joints=joints, observation_terms=terms_of, quantity_sizes={"orientation": 4}))


def read(policy, tmp_path, text):
    (tmp_path / "mapping.yaml").write_text(text)
    return read_mapping(tmp_path / "mapping.yaml", ControllerPlan(policy.info.env, policy.info.spec.frame_stack))


@pytest.mark.parametrize("text", [LIKE, SAME, INDEXED])
def test_targets_are_the_programs(legs, tmp_path, text):
    mapping = read(legs, tmp_path, TARGETS.replace("TARGET", text))
    inputs = {"positions": np.array([0.3, -0.2]), "orientation": np.array([0.0, 0.6, 0.0, 0.8])}
    _, target = OnnxController(encode(build_graph(legs, plan_of(legs)))).step(inputs)
    mapped = OnnxController(encode(build_graph(legs, plan_of(legs), mapping)))
    # Policy: left 0.3, right -0.2. Program: right first, (-0.2 - 0.25) / 0.5 = -0.9 and 0.3 / -0.5 = -0.6.
    program = {"positions": np.array([-0.9, -0.6]), "orientation": np.array([0.8, 0.0, 0.6, 0.0])}
    expected = [(target[1] - 0.25) / 0.5, target[0] / -0.5]
    assert mapped.step(program)[1] == pytest.approx(expected, abs=1e-6)
    mapped.begin()
    assert MappedController(mapped, mapping).step(inputs)[1] == pytest.approx(target, abs=1e-6)
    units = dict(mapped.session.get_modelmeta().custom_metadata_map)["input_units"]
    assert units == "half turns,quaternion w; x; y; z"


def test_what_diagnose_prints_of_actions_is_accepted_with_the_targets(legs, tmp_path):
    swap = Correction("actions", "order", "", (1, 0), (0.8, 1.25), (-0.4, 0.5))  # of the targets, about the stance
    joints = legs.info.env.joints
    printed = build_mapping([], [swap], {"positions": 2}, joints).model_dump(exclude_defaults=True)
    assert printed["targets"] == {"order": [1, 0]}
    mapping = read(legs, tmp_path, yaml_text.dump(printed))
    assert mapping.targets.order.tolist() == [1, 0]
    with pytest.raises(UsageError, match="actions: what diagnose prints there is of the policy's action"):
        read(legs, tmp_path, yaml_text.dump({"actions": printed["actions"]}))


def test_exports_have_the_gains_of_servos_in_their_own_unit(legs):
    joints = dataclasses.replace(legs.info.env.joints, drive_gain=32.0, drive_voltage=7.4)
    env = legs.info.env.model_copy(update={"joints": joints})
    servos = dataclasses.replace(legs, info=legs.info.model_copy(update={"env": env}))
    header = ControllerSource(servos, plan_of(servos), "controller", None).write().header
    assert "const double controller_drive_gain[CONTROLLER_ACTION_SIZE]" in header
    metadata = make_metadata(servos.info)
    assert (metadata["drive_gain"], metadata["drive_voltage"]) == ("32,32", "7.4,7.4")
    assert "drive_gain" not in make_metadata(legs.info)


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_targets_and_units_in_c(legs, tmp_path):
    mapping = read(legs, tmp_path, TARGETS.replace("TARGET", LIKE))
    source = ControllerSource(legs, plan_of(legs), "controller", None, mapping)
    code = source.write()
    assert "float positions[2]; /* the program's value [half turns]: right, left */" in code.header
    assert "float orientation[4]; /* the program's value [quaternion w, x, y, z] */" in code.header
    assert "double target[CONTROLLER_ACTION_SIZE]; /* the program's value [half turns]: right, left */" in code.header
    assert "const double controller_joint_stiffness[CONTROLLER_ACTION_SIZE]" in code.header
    assert "controller_joint_damping" not in code.header
    units = code.source.partition("controller_input_units")[2].partition(";")[0]
    assert '"half turns"' in units
    assert '"quaternion w, x, y, z"' in units
    controller = CController(source.plan, compile_controller(code, tmp_path, find_compiler()), has_target=True)
    program = {"positions": np.array([-0.9, -0.6]), "orientation": np.array([0.8, 0.0, 0.6, 0.0])}
    expected = OnnxController(encode(build_graph(legs, plan_of(legs), mapping))).step(program)[1]
    assert controller.step(program)[1] == pytest.approx(expected, abs=1e-5)
    other = read(legs, tmp_path, "observations: {positions: {scale: 2}}")
    assert (
        "float positions[2]; /* the program's value: left, right */"
        in ControllerSource(legs, plan_of(legs), "controller", None, other).write().header
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("targets: {order: [left, rihgt]}", "no element 'rihgt'. Did you mean 'right'"),
        ("targets: {order: [left, left]}", "order must have each of left, right once"),
        ("targets: {like: positions}", "like: the file maps no observation 'positions'"),
        ("observations: {positions: {scale: 2}}\ntargets: {like: positions, scale: 3}", "exclude each other"),
        ("actions: {sign: [1, -1]}", "the controller returns targets of joints: map them with targets:"),
    ],
)
def test_targets_that_do_not_fit(legs, tmp_path, text, message):
    with pytest.raises(RlctlError) as caught:
        read(legs, tmp_path, text)
    assert message in str(caught.value)


def test_a_computed_term_is_not_mapped(tmp_path):
    env = make_arm(observation_terms={"goal": terms.Gravity("orientation")}, quantity_sizes={"orientation": 4})
    (tmp_path / "mapping.yaml").write_text("observations: {goal: {sign: [1, 1, -1]}}")
    with pytest.raises(UsageError, match="goal is computed inside the controller, from orientation; map that instead"):
        read_mapping(tmp_path / "mapping.yaml", ControllerPlan(env, 1))
