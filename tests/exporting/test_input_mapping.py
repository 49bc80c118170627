"""A controller reads the mapping that `rlctl diagnose` prints: wrong values of a program act as the right ones do."""

import numpy as np
import pytest

from rlctl.deploy.controller_layout import ControllerLayout
from rlctl.errors import RecipeError, UsageError
from rlctl.exporting.c_source import find_compiler
from rlctl.exporting.controller.graph import build_graph
from rlctl.exporting.controller.input_mapping import read_mapping
from rlctl.exporting.controller.players import CController, MappedController, OnnxController, compile_controller
from rlctl.exporting.controller.source import ControllerSource
from rlctl.policy.numpy_policy import NumpyPolicy
from rlctl.policy.onnx_policy import encode
from rlctl.task import terms
from tests.exporting.controllers import make_arm, make_policy

MAPPING = """
observations:
  goal: {order: [1, 2, 0], sign: [1, -1, 1], scale: [0.5, 1, 2], offset: [0, 0, 3]}
log: {observations: {positions: {order: [1, 0]}}}
"""


@pytest.fixture
def policy():
    return make_policy(make_arm())


@pytest.fixture
def maps(policy, tmp_path):
    (tmp_path / "mapping.yaml").write_text(MAPPING)
    return read_mapping(tmp_path / "mapping.yaml", ControllerLayout(policy.info.env, policy.info.spec.frame_stack))


def test_values_and_their_inverse(maps):
    assert list(maps) == ["goal"]  # what only the log has wrong is not changed
    # value = [0.5 * 20, -30, 2 * 10 + 3] for the input [10, 20, 30].
    assert maps["goal"].undo(np.array([10.0, -30.0, 23.0])).tolist() == [10, 20, 30]
    expected = "order [1, 2, 0], factor [0.5, -1.0, 2.0], offset [0.0, 0.0, 3.0]"
    assert maps["goal"].describe() == expected


@pytest.mark.parametrize("form", ["onnx", "c"])
def test_a_controller_maps_its_inputs(policy, maps, tmp_path, form):
    if form == "onnx":
        controller = OnnxController(encode(build_graph(policy, maps)))
    else:
        if find_compiler() is None:
            pytest.skip("no C compiler")
        source = ControllerSource(policy, "controller", None, maps)
        code = source.write()
        assert " *   goal: order [1, 2, 0]," in code.header
        controller = CController(source.layout, compile_controller(code, tmp_path, find_compiler()), has_target=False)
    right = {"positions": np.array([0.1, 0.2]), "goal": np.array([10.0, -30.0, 23.0])}
    wrong = {"positions": right["positions"], "goal": np.array([10.0, 20.0, 30.0])}
    expected = NumpyPolicy(policy).predict(np.concatenate([*right.values()]).astype(np.float32))
    assert np.ravel(controller.step(wrong)[0]) == pytest.approx(expected, abs=1e-5)
    controller.begin()
    assert np.ravel(MappedController(controller, maps).step(right)[0]) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("actions: {sign: [1, -1]}", UsageError, "actions: a controller's outputs are the policy's"),
        ("observations: {gaol: {sign: [1, 1, 1]}}", RecipeError, "no input 'gaol'. Did you mean 'goal'"),
        ("observations: {goal: {sign: [1, 1]}}", RecipeError, "goal: sign has 2 numbers, the input 3"),
        ("observations: {goal: {order: [0, 0, 1]}}", RecipeError, "must have each of 0 to 2 once"),
        ("observations: {goal: {scale: [1, 0, 1]}}", RecipeError, "sign and scale must not be 0"),
        ("observations: {goal: {delay: 1}}", UsageError, "delay 1: a controller cannot undo it"),
        ("observations: {goal: {frame: to body}}", UsageError, "frame to body: a controller cannot undo it"),
    ],
)
def test_what_does_not_fit(policy, tmp_path, text, error, message):
    (tmp_path / "mapping.yaml").write_text(text)
    with pytest.raises(error) as caught:
        read_mapping(tmp_path / "mapping.yaml", ControllerLayout(policy.info.env, policy.info.spec.frame_stack))
    assert message in str(caught.value)


def test_a_computed_term_is_not_mapped(tmp_path):
    env = make_arm(observation_terms={"goal": terms.Gravity("orientation")}, quantity_sizes={"orientation": 4})
    (tmp_path / "mapping.yaml").write_text("observations: {goal: {sign: [1, 1, -1]}}")
    with pytest.raises(UsageError, match="goal is computed inside the controller, from orientation; map that instead"):
        read_mapping(tmp_path / "mapping.yaml", ControllerLayout(env, 1))
