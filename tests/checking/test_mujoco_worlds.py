"""What check-env reads of a MuJoCo model."""

import mujoco

from rlctl.checking.mujoco_worlds import read_world

ARM = """
<mujoco><worldbody><body name="upper">
  <joint name="shoulder" axis="0 1 0"/><geom size="0.1"/>
  <body name="lower" pos="0 0 1"><joint name="elbow" axis="0 1 0"/><geom size="0.1"/></body>
</body></worldbody></mujoco>
"""


def test_a_joint_is_named_with_its_own_body():
    arm, _ = read_world(mujoco.MjModel.from_xml_string(ARM)).bodies
    assert arm.name == "upper"  # a tree is one body, with the name of its root
    assert [arm.name_joint(joint) for joint in arm.joints] == ["shoulder of upper", "elbow of lower"]
