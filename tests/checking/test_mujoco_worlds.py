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


def test_what_touches_nothing_that_moves_is_called_fixed():
    """Messages say that a cube is inside it: the floor is a shape of MuJoCo's world body."""
    world = read_world(mujoco.MjModel.from_xml_string(ARM))
    assert world.link_name((0, -1)) == "what is fixed to the world"
