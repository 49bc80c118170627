"""`lock_joints`: a joint that does not move, in both engines, until the next reset."""

from contextlib import closing

import numpy as np
import pytest

from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.pybullet.sim import PybulletSim

pytest.importorskip("mujoco")
ENGINES = [pytest.param(PybulletSim, marks=pytest.mark.pybullet), MujocoSim]
START = np.full(7, 0.2)  # [rad]


def prepare_drives(arm):
    arm.set_drives([300.0] * 4 + [5.0, 5.0, 0.5], [5.0, 5.0, 2.0, 2.0, 0.1, 0.1, 0.01])


DRIVES = {  # preparation in `build`, command of a step
    "motors": (lambda arm: None, lambda arm: arm.drive_to(START + 0.2)),
    "springs": (prepare_drives, lambda arm: arm.drive_to(START + 0.2, max_force=1000.0)),
    "speeds": (lambda arm: None, lambda arm: arm.drive_at(np.full(7, 0.5))),
    "torques": (lambda arm: arm.disable_motors(), lambda arm: arm.set_torques(np.full(7, 20.0))),
}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("drive", DRIVES)
def test_a_locked_joint_stays_until_the_reset(engine, drive):
    prepare, command = DRIVES[drive]
    with closing(engine(control_dt=0.02, substeps=10)) as sim:
        arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
        prepare(arm)
        sim.save()

        def play(locked):
            sim.restore()
            arm.set_joints(START)
            if locked:
                arm.lock_joints([arm.joint_names[1]])
            for _ in range(15):
                command(arm)
                sim.step()
            return arm.joint_positions

        free = play(locked=False)
        held = play(locked=True)
        assert abs(free[1] - START[1]) > 0.05
        assert held[1] == pytest.approx(START[1], abs=1e-3)
        assert abs(held[0] - START[0]) > 0.05  # the others move
        np.testing.assert_array_equal(play(locked=False), free)  # bit for bit as before
