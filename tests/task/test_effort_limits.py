"""Joints whose model gives no effort limit: the first motor call says so, and `max_force` moves them."""

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.pybullet.sim import PybulletSim
from tests.task import models

pytest.importorskip("mujoco")


@pytest.fixture(params=[pytest.param(PybulletSim, marks=pytest.mark.pybullet), MujocoSim], ids=["pybullet", "mujoco"])
def cart(request, tmp_path):
    """A wheel without `<limit>`, an arm of effort 0, and a lift of effort 50."""
    limit = '<limit lower="-3" upper="3" effort="50" velocity="5"/>'
    wheel = models.joint("wheel", "hull", "left", kind="continuous").replace(limit, "")
    arm = models.joint("arm", "hull", "right", x=0.2).replace("50", "0")
    lift = models.joint("lift", "hull", "top", x=-0.2, kind="prismatic")
    links = [models.link(name, 0.2) for name in ("hull", "left", "right", "top")]
    sim = request.param(control_dt=1 / 60, substeps=4)
    sim.set_gravity(0.0)
    body = sim.load("cart", models.urdf(tmp_path, *links, wheel, arm, lift), fixed=True)
    sim.save()
    yield sim, body
    sim.close()


@pytest.mark.parametrize("method", ["drive_at", "drive_to"])
@pytest.mark.parametrize("joint", ["wheel", "arm"])
def test_the_first_motor_call_names_file_and_joint(cart, method, joint):
    _, body = cart
    with pytest.raises(TaskError) as caught:
        getattr(body, method)(np.ones(1), joints=[joint])
    assert str(caught.value) == (
        f"model.urdf gives no effort limit for joint '{joint}', so its motor would have no force: "
        "pass max_force= [N m], or write <limit effort=...> into the model"
    )
    assert caught.value.exit_code == 3


def test_max_force_moves_them_and_a_limit_of_the_file_needs_none(cart):
    sim, body = cart
    for _ in range(30):
        body.drive_at(np.ones(2), joints=["wheel", "arm"], max_force=1.0)
        body.drive_at(np.full(1, 0.1), joints=["lift"])
        sim.step()
    assert body.joint_velocities == pytest.approx([1.0, 1.0, 0.1], abs=0.01)


def test_a_limit_that_is_not_there_is_unknown_to_controllers(cart):
    assert cart[1].describe_joints(["wheel", "lift"]).max_torque == ()
    assert cart[1].describe_joints(["lift"]).max_torque == (50.0,)
