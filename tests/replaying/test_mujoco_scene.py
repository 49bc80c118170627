"""Recordings of MuJoCo environments: bodies, ground, markers and curves from the model."""

from contextlib import closing

import numpy as np
import pytest

from rlctl.engine import MUJOCO, PYBULLET
from rlctl.environments.spec import EnvSpec
from rlctl.play.episode import load_episode, save_episode
from rlctl.replaying.drawable import make_drawable
from rlctl.replaying.mjcf import ShapeKind
from rlctl.replaying.mujoco_scene import find_mujoco_bounds
from rlctl.replaying.recorder import play_episode
from rlctl.replaying.reproduce import verify_episode
from rlctl.replaying.rrd import write_rrd
from tests.replaying.reading import column, entities, static

mujoco = pytest.importorskip("mujoco")


def play_mujoco(task: str, steps: int = 30):
    """Play random actions; return the rollout and the last positions of all bodies that MuJoCo itself computes."""
    spec = EnvSpec(task)
    with closing(make_drawable(spec)) as env:
        env.action_space.seed(0)

        def choose(observation, step):
            return env.action_space.sample() if step < steps else None

        rollout = play_episode(env, spec, 3, choose, policy="chance", draw=print)
        inner = env.unwrapped
        mujoco.mj_forward(inner.model, inner.data)  # bodies are where the last substep put them
        return rollout, inner.data.xpos.copy()


@pytest.fixture(scope="module")
def cheetah():
    return play_mujoco("HalfCheetah-v5")


def test_bodies_are_where_the_last_substep_put_them(cheetah):
    rollout, positions = cheetah
    ground, robot = rollout.scene.bodies
    assert ground.ground_height == 0.0
    assert robot.positions.shape == (31, len(robot.links), 3)
    np.testing.assert_allclose(robot.positions[-1], positions, atol=1e-12)
    assert robot.joint_names[3:] == ["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]
    assert rollout.dt == pytest.approx(0.05)


def test_geoms_are_drawn_and_actions_have_the_names_of_joints(cheetah, tmp_path):
    rollout, _ = cheetah
    warnings: list[str] = []
    write_rrd(tmp_path / "x.rrd", rollout, title="x", warn=warnings.append)
    assert warnings == []
    robot = rollout.scene.bodies[1]
    assert {shape.kind for shape in robot.shapes} == {ShapeKind.CAPSULE}
    shapes = [entity for entity in entities(tmp_path / "x.rrd") if "/shape_" in entity]
    assert len(shapes) == len(robot.shapes) == 8
    names = static(tmp_path / "x.rrd", "/action", "SeriesLines:names")
    assert names == ["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]
    _, torso = column(tmp_path / "x.rrd", "/world/robot/torso", "Transform3D:translation")
    np.testing.assert_allclose(torso[:, 0], robot.positions[:, 1], atol=1e-6)


MESH = """
<mujoco>
  <asset><mesh name="roof" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/><material name="red" rgba="1 0 0 1"/></asset>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <site name="goal" pos="0.5 0 1"/>
    <body name="box" pos="0 0 1" mocap="true"><geom type="box" size="0.1 0.2 0.3" material="red"/></body>
    <body name="house" pos="0 0 2"><freejoint/>
      <geom type="mesh" mesh="roof"/><geom type="ellipsoid" size="0.1 0.2 0.3"/><geom type="sphere" size="1" group="3"/>
    </body>
  </worldbody>
</mujoco>
"""


def test_meshes_materials_mocap_bodies_and_goal_sites(tmp_path, write_module):
    file = write_module(
        "house.py",
        f"""
        import gymnasium, mujoco, numpy as np
        from gymnasium.spaces import Box

        class House(gymnasium.Env):
            observation_space, action_space, metadata = Box(-9, 9, (1,)), Box(-1, 1, (1,)), {{"render_modes": []}}

            def __init__(self, render_mode=None):
                self.model = mujoco.MjModel.from_xml_string({MESH!r})
                self.data = mujoco.MjData(self.model)

            def reset(self, *, seed=None, options=None):
                super().reset(seed=seed)
                mujoco.mj_resetData(self.model, self.data)
                return np.zeros(1, np.float32), {{}}

            def step(self, action):
                self.data.mocap_pos[0, 0] += 0.1
                mujoco.mj_step(self.model, self.data)
                return np.zeros(1, np.float32), 0.0, False, False, {{}}
        """,
    )
    rollout, _ = play_mujoco(f"{file}:House", steps=3)
    robot = rollout.scene.bodies[1]
    kinds = [(shape.link, shape.kind) for shape in robot.shapes]
    assert kinds == [("box", ShapeKind.BOX), ("house", ShapeKind.MESH), ("house", ShapeKind.SPHERE)]
    assert robot.shapes[0].color == (1.0, 0.0, 0.0, 1.0)
    np.testing.assert_allclose(robot.positions[:, 1, 0], [0.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(rollout.scene.markers["goal"], np.tile([0.5, 0.0, 1.0], (4, 1)))
    write_rrd(tmp_path / "x.rrd", rollout, title="x", warn=pytest.fail)


@pytest.mark.parametrize("task", ["Reacher-v5", "Hopper-v5"])
def test_a_recorded_episode_is_the_same_again(task, tmp_path):
    spec, path = EnvSpec(task), tmp_path / "000000.npz"
    with closing(spec.make()) as env:
        env.action_space.seed(0)
        rollout = play_episode(env, spec, 3, lambda o, step: env.action_space.sample(), policy="chance")
    save_episode(path, rollout.episode)
    assert verify_episode(load_episode(path), path)[1].difference is None


def test_a_trunk_that_moves_is_followed():
    rollout, _ = play_mujoco("Hopper-v5", steps=300)
    robot = rollout.scene.bodies[1]
    moved = float(np.ptp(robot.positions[:, 1, 0]))
    assert robot.trunk == (1 if moved >= 0.3 else None)


def test_a_task_of_rlctl_in_mujoco():
    spec = EnvSpec("quadruped", sim=MUJOCO)
    with closing(make_drawable(spec)) as env:
        zero = np.zeros(env.action_space.shape)
        rollout = play_episode(env, spec, 3, lambda o, step: zero if step < 10 else None, policy="zero", draw=print)
    ground, robot = rollout.scene.bodies
    assert ground.ground_height == pytest.approx(0.0, abs=1e-9)
    assert "robot/trunk" in robot.links
    assert robot.shapes
    assert robot.box[1][0] - robot.box[0][0] < 3.0  # of the robot, without its ground


@pytest.mark.pybullet
@pytest.mark.parametrize("task", ["reach", "quadruped"])
def test_a_task_shows_its_visual_shapes_as_in_pybullet(task):
    shapes = []
    for sim in (PYBULLET, MUJOCO):
        spec = EnvSpec(task, sim=sim)
        with closing(make_drawable(spec)) as env:
            rollout = play_episode(env, spec, 3, lambda observation, step: None, policy="nothing", draw=print)
        links = [(shape.link.rpartition("/")[2], shape.kind) for body in rollout.scene.bodies for shape in body.shapes]
        grounds = [body for body in rollout.scene.bodies if body.ground_height is not None]
        assert len(grounds) == 1
        shapes.append(sorted((link, kind.value) for link, kind in links if link not in ("planeLink", "base_link")))
    assert shapes[0] == shapes[1]
    assert len(shapes[0]) > 5


def test_bounds_of_a_task_leave_out_the_ground():
    with closing(EnvSpec("reach", sim=MUJOCO).make()) as env:
        env.reset(seed=0)
        sim = env.unwrapped.sim
        low, high = find_mujoco_bounds(sim, list(sim.bodies.values()), [np.array([0.0, 2.0, 0.0])])
        assert (high - low).max() < 3.0  # [m]; the ground is 30 m wide
        assert high[1] == 2.0  # the marker
        assert high[2] > sim.body("arm").link_position("lbr_iiwa_link_4")[2]
        empty, _ = find_mujoco_bounds(sim, [sim.body("plane")], [])
        assert empty.tolist() == [-1, -1, -1]
