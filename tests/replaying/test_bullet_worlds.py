"""Recordings of plain environments in PyBullet: what is read of their worlds, and that reading changes nothing."""

import inspect
import itertools
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rlctl.environments.spec import EnvSpec
from rlctl.play.episode import load_episode, save_episode
from rlctl.replaying.bullet_bodies import place_links, read_bodies, read_body, read_state
from rlctl.replaying.drawable import make_drawable
from rlctl.replaying.mjcf import ShapeKind, read_shapes
from rlctl.replaying.pictures import take_pictures
from rlctl.replaying.recorder import Rollout, play_episode
from rlctl.replaying.replay import run_replay
from rlctl.replaying.replay_request import ReplayRequest
from rlctl.replaying.reproduce import verify_episode
from rlctl.replaying.rrd import write_rrd

p = pytest.importorskip("pybullet", reason="PyBullet is not installed")
pybullet_data = pytest.importorskip("pybullet_data")

from tests.replaying.bullet_envs import ARM, HELD, LOADED, PAINTED, REMOVED, STEPS, TIP  # noqa: E402
from tests.replaying.reading import chunks, column, entities, layout, static  # noqa: E402

ENVS = Path(__file__).with_name("bullet_envs.py")
DATA = Path(pybullet_data.getDataPath())


def play(name: str, steps: int = STEPS, draw: bool = True, **parameters) -> tuple[Rollout, list[str]]:
    """Play two episodes with random actions; return the second one, and the warnings."""
    spec, warnings = EnvSpec(f"{ENVS}:{name}", parameters), []
    with closing(make_drawable(spec) if draw else spec.make()) as env:
        env.action_space.seed(0)
        actions = [env.action_space.sample() for _ in range(2 * steps)]
        for episode in (actions[:steps], actions[steps:]):
            played = itertools.chain(episode, [None])
            rollout = play_episode(env, spec, 3, lambda o, k, a=played: next(a), draw=warnings.append if draw else None)
    return rollout, warnings


@pytest.fixture(scope="module")
def workshop():
    rollout, warnings = play("Workshop")
    assert warnings == []
    return rollout


@pytest.fixture(scope="module")
def recording(workshop, tmp_path_factory):
    path, warnings = tmp_path_factory.mktemp("workshop") / "w.rrd", []
    write_rrd(path, workshop, title="workshop", warn=warnings.append)
    assert warnings == []
    return path


def find(rollout: Rollout, name: str):
    return next(body for body in rollout.scene.bodies if body.name == name)


def test_recording_an_episode_does_not_change_it(workshop):
    plain, _ = play("Workshop", draw=False)
    np.testing.assert_array_equal(workshop.episode.observations, plain.episode.observations)
    np.testing.assert_array_equal(workshop.episode.rewards, plain.episode.rewards)


def test_the_bodies_of_the_episode_are_read(workshop):
    assert {body.name for body in workshop.scene.bodies} == {"plane", "arm", "body 2"}
    arm = find(workshop, "arm")
    assert (arm.links, arm.joint_names) == (["foot", "upper", "tip"], ["shoulder", "slide"])
    assert find(workshop, "plane").ground_height == pytest.approx(0.001)  # PyBullet's margin
    assert [shape.kind for shape in arm.shapes] == [ShapeKind.BOX, ShapeKind.CAPSULE, ShapeKind.SPHERE]
    assert arm.shapes[0].color == (0, 0, 1, 1)
    assert arm.shapes[2].size == (0.05,)


@pytest.mark.slow
def test_links_are_drawn_where_the_last_substep_put_them(workshop, recording):
    arm = find(workshop, "arm")
    client = p.connect(p.DIRECT)
    body = p.loadURDF(str(ARM), useFixedBase=True, physicsClientId=client)
    for joint, position in enumerate(arm.joint_positions[-1]):
        p.resetJointState(body, joint, position, physicsClientId=client)
    state = p.getLinkState(body, TIP, computeForwardKinematics=1, physicsClientId=client)
    p.disconnect(client)
    np.testing.assert_allclose(arm.positions[-1, TIP + 1], state[4], atol=1e-9)
    steps, positions = column(recording, "/world/arm/tip", "Transform3D:translation")
    assert steps.tolist() == list(range(STEPS + 1))
    np.testing.assert_allclose(positions[-1, 0], state[4], atol=1e-6)
    _, slide = column(recording, "/joints/position/arm")
    np.testing.assert_array_equal(slide, arm.joint_positions)


@pytest.mark.slow
def test_a_body_that_comes_and_goes_is_drawn_while_it_exists(workshop, recording):
    assert find(workshop, "body 2").list_spans() == [range(LOADED, REMOVED)]
    cube = "/world/body\\ 2"
    # It exists in the steps 3 to 6.
    assert column(recording, f"{cube}/link0", "Transform3D:translation")[0].tolist() == [3, 4, 5, 6]
    assert column(recording, cube, "Clear:is_recursive")[0].tolist() == [7]
    assert column(recording, f"{cube}/link0/shape_0", "Boxes3D:half_sizes")[0].tolist() == [3]


def test_colours_that_change(recording):
    steps, colors = column(recording, "/world/body\\ 2/link0/shape_0", "Boxes3D:colors")
    by_step = {int(step): int(color[0]) for step, color in zip(steps, colors, strict=True)}  # RGBA, a byte each
    assert by_step == {LOADED: 0xFFFFFFFF, PAINTED: 0xFF0000FF}


def test_constraints_and_debug_lines(workshop, recording):
    constraints = workshop.scene.lines["world", "constraints"]
    assert [step for step, lines in enumerate(constraints) if lines] == [HELD, PAINTED, REMOVED - 1]
    # From the tip's centre of mass to the pivot in the cube: the pivots of tip and cube come together.
    ends = np.array([[line.start, line.end] for line in constraints[REMOVED - 1]])
    arm, cube = find(workshop, "arm"), find(workshop, "body 2")
    center = arm.positions[6, 2] + Rotation.from_quat(arm.orientations[6, 2]).apply([0.1, 0, 0])
    np.testing.assert_allclose(ends[0, 0], center, atol=1e-9)
    np.testing.assert_allclose(ends[-1, 1], cube.positions[6, 0], atol=1e-9)
    # One line replaces that of the step before.
    steps, lines = column_of_strips(recording, "/world/debug\\ lines")
    assert steps == list(range(STEPS + 1))
    assert [len(strips) for strips in lines] == [0] + [1] * STEPS


def column_of_strips(path: Path, entity: str):
    rows = [
        row
        for batch in chunks(path, entity, "LineStrips3D:strips")
        for row in zip(batch.column("step").to_pylist(), batch.column("LineStrips3D:strips").to_pylist(), strict=True)
    ]
    rows.sort(key=lambda row: row[0])
    return [step for step, _ in rows], [strips for _, strips in rows]


def test_each_client_is_a_world(tmp_path):
    rollout, _ = play("Workshop", worlds=2)
    write_rrd(tmp_path / "two.rrd", rollout, title="two", warn=print)
    found = entities(tmp_path / "two.rrd")
    assert {"/world/arm/tip", "/world\\ 2/arm/tip", "/joints/position/world\\ 2/arm"} <= found
    np.testing.assert_allclose(
        rollout.scene.bodies[-1].positions[:, 0], np.tile([1.0, 0, 0], (STEPS + 1, 1)), atol=1e-9
    )
    assert {"world", "world 2"} <= set(layout(tmp_path / "two.rrd", "ViewBlueprint:display_name"))


def test_clients_of_others_are_not_drawn():
    client = p.connect(p.DIRECT)
    p.loadURDF(str(ARM), physicsClientId=client)
    rollout, _ = play("Workshop")
    assert {body.world for body in rollout.scene.bodies} == {"world"}
    assert client in {body.client for body in read_bodies()}
    p.disconnect(client)


def test_a_client_of_all_instances_is_drawn_for_each():
    for _ in range(2):
        rollout, warnings = play("Shared", steps=1)
        assert warnings == []
        assert [body.name for body in rollout.scene.bodies] == ["plane", "arm"]


def test_mjcf_files_and_meshes_of_arrays_are_drawn(tmp_path):
    rollout, warnings = play("Crawler", steps=2)
    write_rrd(tmp_path / "c.rrd", rollout, title="c", warn=warnings.append)
    assert warnings == []
    ant = find(rollout, "ant")
    assert ant.shapes == read_shapes(DATA / "mjcf/ant.xml")
    assert ant.trunk == 0
    hills, tent, hidden = (find(rollout, f"body {number}") for number in range(3))
    # A grid of 3 x 2 points 0.5 m apart; heights of 0 to 0.5, twice as high, around their middle.
    mesh = hills.shapes[0].mesh
    assert mesh.vertices[0].tolist() == [-0.5, -0.25, -0.5]
    assert mesh.vertices[-1].tolist() == [0.5, 0.25, 0.5]
    assert len(mesh.triangles) == 4
    assert tent.shapes[0].mesh.vertices.max() == 2.0
    assert hidden.shapes == []
    assert len(static(tmp_path / "c.rrd", "/world/body\\ 1/link0/shape_0", "Mesh3D:vertex_positions")) == 4


def test_geoms_of_the_world_are_bodies_with_their_names(tmp_path):
    rollout, _ = play("Crawler", steps=2, file="mjcf/reacher.xml")
    # fromto="-.3 -.3 .01 .3 -.3 .01": along x.
    (side,) = find(rollout, "reacher sideS").shapes
    assert side.position == pytest.approx((0, -0.3, 0.01))
    np.testing.assert_allclose(np.abs(Rotation.from_quat(side.orientation).apply([0, 0, 1])), [1, 0, 0], atol=1e-9)
    assert find(rollout, "reacher ground").ground_height == 0.0


def test_a_body_that_diverged_is_drawn_until_then(tmp_path):
    rollout, _ = play("Diverging")
    assert find(rollout, "arm (2)").list_spans() == [range(5)]
    assert [step for step, lines in enumerate(rollout.scene.lines["world", "constraints"]) if lines] == [HELD]
    write_rrd(tmp_path / "d.rrd", rollout, title="d", warn=print)
    tip = "/world/arm\\ \\(2\\)/tip"
    assert column(tmp_path / "d.rrd", tip, "Transform3D:translation")[0].tolist() == [0, 1, 2, 3, 4]


def test_soft_bodies_cost_a_warning():
    rollout, warnings = play("Jelly", steps=2)
    assert [body.name for body in rollout.scene.bodies] == ["arm"]
    assert set(warnings) == {"the soft body 'cube' is not drawn"}


def test_functions_are_restored():
    with closing(make_drawable(EnvSpec(f"{ENVS}:Workshop"))):
        assert type(p.loadMJCF) is not type(p.connect)
        assert inspect.isbuiltin(p.loadMJCF)  # BulletClient adds its client to builtins only
    assert type(p.loadMJCF) is type(p.connect)


@pytest.mark.slow
def test_an_episode_is_verified_filmed_and_pictured(workshop, tmp_path):
    file = tmp_path / "w.npz"
    save_episode(file, workshop.episode)
    _, verification = verify_episode(load_episode(file), file)
    # It was the second episode of its environment; the world is built again at every reset.
    assert verification.difference is None
    film = run_replay(ReplayRequest(str(file), video=tmp_path / "film.gif")).film
    assert (film.width, film.height) == (400, 300)
    strip = take_pictures(load_episode(file), 3)
    assert [step for step, _ in strip.pictures] == [0, STEPS // 2, STEPS]


@pytest.mark.slow
@pytest.mark.parametrize(
    "file",
    [
        "kuka_iiwa/model.urdf", "r2d2.urdf", "spherical_joint_limit.urdf", "laikago/laikago.urdf", "mjcf/ant.xml",
        "mjcf/humanoid.xml",
    ],
)  # fmt: skip
def test_links_are_placed_as_pybullet_places_them(file):
    client, rng = p.connect(p.DIRECT), np.random.default_rng(0)
    path = str(DATA / file)
    pose = [1, 2, 3], [0, 0.6, 0, 0.8]
    is_mjcf, where = path.endswith("xml"), {"physicsClientId": client}
    bodies = p.loadMJCF(path, **where) if is_mjcf else [p.loadURDF(path, *pose, **where)]
    for body in (read_body(client, body) for body in bodies):
        for index, joint in enumerate(body.joints):
            if joint.moves:
                p.resetJointState(body.id, index, rng.uniform(-1, 1), **where)
            elif joint.kind == p.JOINT_SPHERICAL:
                p.resetJointStateMultiDof(body.id, index, Rotation.random(rng=rng).as_quat().tolist(), **where)
        positions, orientations = place_links(body, [read_state(body)] * 2)
        states = p.getLinkStates(body.id, range(len(body.joints)), computeForwardKinematics=1, **where) or ()
        for index, state in enumerate(states, start=1):
            np.testing.assert_allclose(positions[1, index], state[4], atol=1e-7)
            turn = Rotation.from_quat(orientations[1, index]) * Rotation.from_quat(state[5]).inv()
            assert turn.magnitude() < 1e-6
    p.disconnect(client)
