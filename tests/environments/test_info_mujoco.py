"""What is read from the model of an environment that MuJoCo simulates."""

from contextlib import closing
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from rlctl.environments.info import describe
from rlctl.environments.simulations import describe_mujoco_model, find_mujoco
from rlctl.environments.spec import EnvSpec

mujoco = pytest.importorskip("mujoco")


def about(task: str):
    with closing(EnvSpec(task).make()) as env:
        return describe(env)


def test_control_dt_is_not_the_rounded_number_of_frames():
    assert about("Humanoid-v5").control_dt == pytest.approx(0.015)  # 67 frames per second would be 0.0149


def test_joints_are_those_of_the_actuators():
    joints = about("HalfCheetah-v5").joints
    assert joints.names == ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
    assert (joints.low[0], joints.high[0]) == pytest.approx((-0.52, 1.05))
    assert joints.max_torque == (120.0, 90.0, 60.0, 120.0, 60.0, 30.0)


def test_limits_are_left_out_where_a_joint_has_none():
    joints = about("Reacher-v5").joints
    assert joints.names == ("joint0", "joint1")
    assert joints.low == ()
    assert joints.max_torque == (200.0, 200.0)


ARM = """<mujoco><worldbody>
<body><joint name="yaw" axis="0 0 1"/><geom size=".1"/>
<body pos="1 0 0"><joint name="elbow" axis="0 1 0" range="-90 90"/><geom size=".1"/></body></body>
</worldbody><actuator><position joint="elbow"/><position joint="yaw"/></actuator></mujoco>"""


class Arm(gymnasium.Env):
    """Yaw and elbow follow targets that change by the action; the model's actuators are elbow and yaw."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gymnasium.spaces.Box(-1, 1, (2,))
    mix = np.array([[0.0, 1.0], [1.0, 0.0]])  # ctrl for a target of 1 of each joint

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(ARM)
        self.data = mujoco.MjData(self.model)
        self.episodes = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.np_random.uniform(-0.1, 0.1, 2)
        self.target = self.data.qpos.copy()
        self.episodes += 1
        return self.data.qpos.astype(np.float32), {}

    def step(self, action):
        self.target += 0.1 * action
        self.data.ctrl[:] = self.mix @ self.target
        mujoco.mj_step(self.model, self.data, 5)
        return self.data.qpos.astype(np.float32), 0.0, False, False, {}


class InXmlOrder(Arm):
    mix = np.eye(2)


class Coupled(Arm):
    mix = np.array([[0.5, 0.5], [0.5, -0.5]])


class Raises(Arm):
    def step(self, action):
        raise ValueError("no step")


@pytest.mark.parametrize(("env", "names"), [(Arm, ("yaw", "elbow")), (InXmlOrder, ("elbow", "yaw"))])
def test_joints_are_in_the_measured_order_of_the_action(env, names):
    assert describe(env()).joints.names == names


def test_limits_follow_the_order_of_the_action():
    env = Arm()
    env.model.jnt_limited[:], env.model.jnt_range[:] = True, [[-2, 2], [-1, 1]]  # yaw, elbow
    assert (describe(env).joints.low, describe(env).joints.high) == ((-2, -1), (2, 1))


@pytest.mark.parametrize("env", [Coupled, Raises])
def test_joints_are_left_out_where_the_order_is_not_known(env):
    assert describe(env()).joints is None


def test_an_error_that_is_not_of_the_environment_is_raised_while_the_order_is_measured(monkeypatch):
    def fail():
        raise RuntimeError("a mistake of rlctl")

    monkeypatch.setattr(mujoco, "get_mjcb_control", fail)
    with pytest.raises(RuntimeError, match="a mistake of rlctl"):
        describe(Arm())


def test_measuring_the_order_leaves_the_environment_alone():
    env = Arm()
    env.reset(seed=7)
    before, drawn = env.data.qpos.copy(), env.np_random.bit_generator.state
    assert describe(env).joints is not None
    assert (env.data.qpos == before).all()
    assert (env.episodes, env.data.time, env.np_random.bit_generator.state) == (1, 0.0, drawn)
    assert mujoco.get_mjcb_control() is None


class Drawing:
    """A renderer: a copy would free the context of OpenGL that it shares."""

    __module__ = "mujoco.renderer"

    def __deepcopy__(self, memo):
        raise TypeError("cannot be copied")


def test_what_draws_is_not_copied_to_measure_the_order():
    env = Arm()
    env.viewer = SimpleNamespace(renderer=Drawing())
    assert describe(env).joints.names == ("yaw", "elbow")
    env.other = (line for line in ())  # a generator cannot be copied
    assert describe(env).joints is None


def make_model(bodies: int):
    balls = "".join("<body><freejoint/><geom size='.1'/></body>" for _ in range(bodies))
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{balls}</worldbody></mujoco>")


class Held(gymnasium.Env):
    """Holds its model and data under `attributes`."""

    def __init__(self, **attributes):
        vars(self).update(attributes)


def test_model_and_data_are_found_under_any_name_and_one_object_deep():
    model, other = make_model(2), make_model(1)
    data = mujoco.MjData(model)
    assert find_mujoco(Held(mjModel=model, mjData=data)) == (model, data)
    assert find_mujoco(Held(planner=other, robot=SimpleNamespace(m=model, d=data))) == (model, data)
    assert find_mujoco(Held(planner=other, d=data)) is None  # they do not fit each other


def test_other_environments_have_no_model():
    info = about("Pendulum-v1")
    assert (info.control_dt, info.joints) == (None, None)


@pytest.mark.parametrize(
    ("task", "line"),
    [
        ("Reacher-v5", "0.07845 kg; joints: joint0, joint1 -3 to 3, target_x -0.27 to 0.27, target_y -0.27 to 0.27"),
        ("Pendulum-v1", ""),
    ],
)
def test_check_env_describes_a_model_in_one_line(task, line):
    with closing(EnvSpec(task).make()) as env:
        assert describe_mujoco_model(env) == line


def test_a_model_without_joints_has_its_mass():
    drone = '<body><freejoint/><geom size="0.1" mass="0.5"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{drone}</worldbody></mujoco>")
    assert describe_mujoco_model(Held(model=model, data=mujoco.MjData(model))) == "0.5 kg"
