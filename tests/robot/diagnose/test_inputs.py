"""Mistakes of a controller's inputs: what the policy would have observed without them, and that they are named."""

import numpy as np
import pytest

from rlctl.task.terms import Gravity
from rlctl_robot.diagnose.candidates import make_sign
from rlctl_robot.diagnose.diagnose import _describe_on_robot
from rlctl_robot.diagnose.inputs import ControllerInputs
from tests.limits.conftest import make_arm


@pytest.fixture
def info():
    return make_arm().model_copy(
        update={
            "observation_sizes": {"positions": 2, "gravity": 3},
            "observation_terms": {"gravity": Gravity("orientation")},
            "quantity_sizes": {"orientation": 4},
        }
    )


def make_inputs(info, quaternion):
    values = np.array([[0.1, 0.2, *quaternion]] * 3)
    sizes = {"positions": 2, "orientation": 4}
    return ControllerInputs(info, sizes, values, np.zeros((3, 2)), (3,))


def find_right(inputs):
    """Return the mistakes without which gravity is that of a body that rolled by 90 degrees: along -y."""
    found = []
    for mistake in inputs.list_mistakes():
        gravity = inputs.compute_observations(mistake)[0, 2:]
        if np.allclose(gravity, [0.0, -1.0, 0.0], atol=1e-6):
            found.append(mistake)
    return found


HALF = np.sqrt(0.5)


def test_gravity_is_computed_again_from_a_quaternion_in_another_order(info):
    # A roll of 90 degrees is x = w = sqrt(1/2): down, -z in the world, is -y in the body.
    right = make_inputs(info, (HALF, 0.0, 0.0, HALF))
    assert right.compute_observations()[0] == pytest.approx([0.1, 0.2, 0.0, -1.0, 0.0])
    assert [one.text[:39] for one in find_right(make_inputs(info, (HALF, HALF, 0.0, 0.0)))] == [
        "the quaternion is in the order w, x, y,"
    ]
    assert [one.kind for one in find_right(make_inputs(info, (-HALF, 0.0, 0.0, HALF)))] == ["sign"]
    both = find_right(make_inputs(info, (HALF, -HALF, 0.0, 0.0)))
    assert [one.text.count("conjugate") for one in both] == [1]


def test_what_the_log_does_not_hold_is_not_in_the_mapping(info):
    inputs = make_inputs(info, (0.0, 0.0, 0.0, 1.0))
    assert inputs.find_sources("gravity") == ("orientation",)
    assert inputs.find_sources("positions") == ()
    text = _describe_on_robot(make_sign("gravity", 3, range(3)), inputs)
    assert text == ("gravity: all elements have the wrong sign (not in the mapping: it is computed from orientation)")
